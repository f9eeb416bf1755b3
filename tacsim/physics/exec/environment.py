"""One environment inside a kernel: its index, and the small arrays that all environments share.

Such a group exists only while a kernel is compiled: ``ti.static(...)`` makes it from the kernel's arguments, and it
takes no time when the kernel runs (docs/decisions/0012).
"""

from typing import Any, NamedTuple

from tacsim.compute.runtime import ti
from tacsim.physics.exec.lanes import ON_DEVICE, PARTS, vec3

# Large arrays have one axis, and kernels compute the index: with several axes the compiler does not find neighbours.
Floats = ti.types.ndarray(dtype=ti.f32, ndim=1)
Params = ti.types.ndarray(dtype=ti.f32, ndim=2)  # (environments, PARAMS): see tacsim.physics.exec.layout
Counts = ti.types.ndarray(dtype=ti.i32, ndim=2)  # (environments, COUNTS)
Partial = ti.types.ndarray(dtype=ti.f32, ndim=3)  # (environments, PARTS, NUMBERS)

# Argument pack of these arrays. All names in the argument packs of a kernel must differ: Taichi 1.7 confuses equal
# ones.
EnvironmentArrays = ti.types.argpack(params=Params, counts=Counts, partial=Partial)


class Environment(NamedTuple):
    """Argument of all functions of a kernel; indices of numbers are in tacsim.physics.exec.layout."""

    index: Any
    params: Any
    counts: Any
    partial: Any

    @ti.func
    def param(self, name):
        return self.params[self.index, name]

    @ti.func
    def param3(self, name):
        """A vector of three consecutive numbers."""
        return vec3(
            self.params[self.index, name], self.params[self.index, name + 1], self.params[self.index, name + 2]
        )  # fmt: skip

    @ti.func
    def count(self, name):
        return self.counts[self.index, name]


# Records of a part in `partial`. On the CPU a slot has one writer. On a device it has many: sums start from a zero that
# the kernel has written, and values without effect are not written, since writers wait for each other.


@ti.func
def record_sum(env: ti.template(), slot, number, value):
    """Records the part's sum of one substep."""
    if ti.static(ON_DEVICE):
        if value != 0.0:  # true of NaN
            ti.atomic_add(env.partial[env.index, slot, number], value)
    else:
        env.partial[env.index, slot, number] = value


@ti.func
def record_addition(env: ti.template(), slot, number, value):
    """Adds to a sum over the whole launch."""
    if ti.static(ON_DEVICE):
        if value != 0.0:
            ti.atomic_add(env.partial[env.index, slot, number], value)
    else:
        env.partial[env.index, slot, number] += value


@ti.func
def record_min(env: ti.template(), slot, number, value):
    if ti.static(ON_DEVICE):
        if value < env.partial[env.index, slot, number]:
            ti.atomic_min(env.partial[env.index, slot, number], value)
    else:
        env.partial[env.index, slot, number] = ti.min(env.partial[env.index, slot, number], value)


@ti.func
def share_min(env: ti.template(), part, number):
    """Gives a part the smallest of what all parts have recorded: in a stage after that, by all parts."""
    for other in ti.static(range(PARTS)):
        record_min(env, part, number, env.partial[env.index, other, number])


@ti.func
def record_max(env: ti.template(), slot, number, value):
    if ti.static(ON_DEVICE):
        if value > env.partial[env.index, slot, number]:
            ti.atomic_max(env.partial[env.index, slot, number], value)
    else:
        env.partial[env.index, slot, number] = ti.max(env.partial[env.index, slot, number], value)

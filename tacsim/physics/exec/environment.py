"""One environment inside a kernel: its index, and the small arrays that all environments share.

Such a group exists only while a kernel is compiled: ``ti.static(...)`` makes it of the kernel's arguments, and it costs
nothing when the kernel runs (docs/decisions/0012).
"""

from typing import Any, NamedTuple

from tacsim.compute.runtime import ti
from tacsim.physics.exec.lanes import ON_DEVICE, vec3

# Large arrays have one axis: kernels work out one index beforehand. With several the compiler sees no neighbours.
Floats = ti.types.ndarray(dtype=ti.f32, ndim=1)
Params = ti.types.ndarray(dtype=ti.f32, ndim=2)  # (environments, PARAMS): see tacsim.physics.exec.layout
Counts = ti.types.ndarray(dtype=ti.i32, ndim=2)  # (environments, COUNTS)
Partial = ti.types.ndarray(dtype=ti.f32, ndim=3)  # (environments, PARTS, NUMBERS)

# How kernels take these arrays. Names of all argument packs of a kernel must differ: Taichi 1.7 confuses equal ones.
EnvironmentArrays = ti.types.argpack(params=Params, counts=Counts, partial=Partial)


class Environment(NamedTuple):
    """What every function of a kernel knows; numbers by their names in tacsim.physics.exec.layout."""

    index: Any
    params: Any
    counts: Any
    partial: Any

    @ti.func
    def param(self, name):
        return self.params[self.index, name]

    @ti.func
    def param3(self, name):
        """A vector of three numbers, one after the other."""
        return vec3(
            self.params[self.index, name], self.params[self.index, name + 1], self.params[self.index, name + 2]
        )  # fmt: skip

    @ti.func
    def count(self, name):
        return self.counts[self.index, name]


# What a part notes in `partial`. On the CPU a slot has one writer. On a device it has many, so a sum starts from a zero
# that the launch's kernel has put there, and what changes nothing is not written, since writers wait for each other.


@ti.func
def record_sum(env: ti.template(), slot, number, value):
    """The part's whole sum of one substep."""
    if ti.static(ON_DEVICE):
        if value != 0.0:  # true of NaN
            ti.atomic_add(env.partial[env.index, slot, number], value)
    else:
        env.partial[env.index, slot, number] = value


@ti.func
def record_more(env: ti.template(), slot, number, value):
    """What is added over a launch."""
    if ti.static(ON_DEVICE):
        if value != 0.0:
            ti.atomic_add(env.partial[env.index, slot, number], value)
    else:
        env.partial[env.index, slot, number] += value


@ti.func
def record_least(env: ti.template(), slot, number, value):
    if ti.static(ON_DEVICE):
        if value < env.partial[env.index, slot, number]:
            ti.atomic_min(env.partial[env.index, slot, number], value)
    else:
        env.partial[env.index, slot, number] = ti.min(env.partial[env.index, slot, number], value)


@ti.func
def record_most(env: ti.template(), slot, number, value):
    if ti.static(ON_DEVICE):
        if value > env.partial[env.index, slot, number]:
            ti.atomic_max(env.partial[env.index, slot, number], value)
    else:
        env.partial[env.index, slot, number] = ti.max(env.partial[env.index, slot, number], value)

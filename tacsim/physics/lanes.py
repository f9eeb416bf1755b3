"""Eight of everything at once: how kernels are laid out so that the CPU works on whole vectors.

Taichi's loops are scalar; LLVM merges eight equal scalar operations into one vector operation only if it finds them
side by side, starting from stores to neighbouring addresses that it has seen before. Hence `real` holds one number of
eight neighbours (particles, elements, nodes), arrays keep these eight side by side, and `keep_or` and `anchor` store in
the way that is recognised.

Work is cut into PARTS, whatever the number of threads: every part scatters into copies of its own, which are summed in
a fixed order. Hence no atomics on the CPU, and the same bits with any number of threads.
"""

from tacsim.runtime import ti

LANES = 8  # floats in a vector register of AVX2
PARTS = 4

vec3 = ti.types.vector(3, ti.f32)
vec4 = ti.types.vector(4, ti.f32)
real = ti.types.vector(LANES, ti.f32)  # one number of LANES neighbours

Work = ti.types.ndarray(dtype=real, ndim=1)  # SLOTS for each environment and part: where anchors are dropped
SLOTS = 64
Facts = ti.types.ndarray(dtype=ti.f32, ndim=2)  # (environments, facts)
Counts = ti.types.ndarray(dtype=ti.i32, ndim=2)  # (environments, counts)
Partial = ti.types.ndarray(dtype=ti.f32, ndim=3)  # (environments, PARTS, numbers)


def padded(n: int) -> int:
    """n rounded up to whole lanes."""
    return -(-n // LANES) * LANES


@ti.func
def keep_or(never, old, new):
    """new; `old` in words only (never is 0, which the compiler can't know): a value stored over the one just read."""
    return ti.bit_cast(ti.bit_cast(new, ti.i32) | (ti.bit_cast(old, ti.i32) & never), ti.f32)


@ti.func
def anchor(work: ti.template(), slot, value, never):
    """Where the compiler starts to merge lanes: long chains of operations need one every ten or so."""
    work[slot] = keep_or(never, work[slot], value)


@ti.func
def first_of(count, part, parts):
    """Where share `part` of `count` things begins; it ends where the next begins."""
    return count * part // parts

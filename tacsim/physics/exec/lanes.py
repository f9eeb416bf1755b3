"""Eight of everything at once: how kernels are laid out so that the CPU works on whole vectors.

Taichi's loops are scalar; LLVM merges eight equal scalar operations into one vector operation only if it finds them
side by side, starting from stores to neighbouring addresses that it has seen before. Hence arrays keep one number of
eight neighbours (particles, elements, nodes; `lanes`) side by side, and `overwrite` stores so that LLVM recognises it.

Work is cut into PARTS, whatever the number of threads: every part scatters into copies of its own, which are summed in
a fixed order. Hence no atomics on the CPU, and the same bits with any number of threads.

On a device (a GPU) the same functions run with one lane, and a part is a single thing, a particle or a node with a
thread of its own; there is one copy, and what is scattered is added atomically. The switch is ON_DEVICE, known when a
kernel is compiled.
"""

import math
import platform
import re
from pathlib import Path

import numpy as np

from tacsim.compute.runtime import DEVICE, ti


def registers_of_four() -> bool:
    """Whether kernels get vector registers of four floats, not of eight: on ARM, and on AMD's CPUs after Zen 4, which
    LLVM 15, by which Taichi 1.7 compiles, does not know and takes for one with SSE2 (docs/decisions/0007)."""
    if platform.machine().lower() in ("arm64", "aarch64"):
        return True
    try:
        about = Path("/proc/cpuinfo").read_text()
    except OSError:  # not Linux
        return False
    family = re.search(r"^vendor_id\s*: AuthenticAMD\ncpu family\s*: (\d+)$", about, re.MULTILINE)
    return family is not None and int(family[1]) > 25


ON_DEVICE = DEVICE != "cpu"
LANES = 1 if ON_DEVICE else 8  # floats in a vector register of AVX2; a GPU's threads are its lanes
PARTS = 4  # of an environment's work on the CPU; of its sums everywhere
CACHE_LINE = 16  # floats
MAX_NUMBERS = 2**30  # numbers in an array that kernels take
COPIES = 1 if ON_DEVICE else PARTS  # of what is scattered into

# Neighbours along a line of the body's grid in one vector register: a strip
NODES = 1 if ON_DEVICE or registers_of_four() else 2

vec2 = ti.types.vector(2, ti.f32)
vec3 = ti.types.vector(3, ti.f32)
vec4 = ti.types.vector(4, ti.f32)
ivec3 = ti.types.vector(3, ti.i32)
lanes = ti.types.vector(LANES, ti.f32)  # one number of LANES neighbours
strip = ti.types.vector(4 * NODES, ti.f32)  # four numbers of each of NODES neighbours


def padded(n: int) -> int:
    """n rounded up to whole lanes."""
    return -(-n // LANES) * LANES


def aligned_zeros(*shape: int) -> np.ndarray:
    """float32 zeros that begin at a cache line, so that no vector register's worth of them lies across two.

    Raises MemoryError for more than kernels can count (see `bounded`): 4 GB.
    """
    count = math.prod(shape)
    if count > MAX_NUMBERS:
        raise MemoryError(
            f"an array of {count:,} numbers, kernels count to {MAX_NUMBERS:,}: use a coarser "
            f"preset, or fewer worlds a batch"
        )
    memory = np.zeros(count + CACHE_LINE, np.float32)
    start = -memory.ctypes.data // 4 % CACHE_LINE
    return memory[start : start + count].reshape(shape)


@ti.func
def filled(value, rows: ti.template(), columns: ti.template()):
    """A matrix (rows, columns) full of one number. In place of Matrix.zero, whose every zero is a constant of its own:
    Taichi compiles for as long as there are constants, squared (docs/decisions/0017)."""
    return ti.Matrix(ti.static([[value] * columns] * rows))


@ti.func
def overwrite(zero, old, new):
    """Returns `new`. `old` is used in name only (`zero` is 0, which the compiler cannot know): LLVM makes vectors of a
    value stored over the one just read."""
    if ti.static(ON_DEVICE):
        return new
    else:
        return ti.bit_cast(ti.bit_cast(new, ti.i32) | (ti.bit_cast(old, ti.i32) & zero), ti.f32)


@ti.func
def opaque(zero, index):
    """Returns `index`. The compiler would take a sum of several indices apart, and see no neighbours behind it."""
    return index | zero


@ti.func
def bounded(index, width: ti.template()):
    """Returns `index`, of things of `width` numbers. Since it is neither negative nor large, the compiler sees which
    numbers behind it are neighbours."""
    if ti.static(ON_DEVICE):
        return index
    else:
        return index & (MAX_NUMBERS // width - 1)


@ti.func
def load_lanes(array: ti.template(), at):
    """LANES neighbours, from any place on."""
    start = bounded(at, 1)
    return lanes([array[start + lane] for lane in range(LANES)])


@ti.func
def store_lanes(array: ti.template(), at, values, zero):
    start = bounded(at, 1)
    kept = lanes([overwrite(zero, array[start + lane], values[lane]) for lane in range(LANES)])
    for lane in ti.static(range(LANES)):
        array[start + lane] = kept[lane]


@ti.func
def load_rows(particles: ti.template(), at, stride, first: ti.template(), count: ti.template(), rows: ti.template()):
    """Rows first, ... of a block of LANES particles, `count` of them. In short loops: LLVM cuts a longer one across the
    rows, and gathers."""
    for begin in ti.static(range(0, count, 6)):
        for r in range(begin, min(begin + 6, count)):
            start = bounded(at + (first + r) * stride, 1)
            values = lanes([particles[start + lane] for lane in range(LANES)])
            for lane in ti.static(range(LANES)):
                rows[r, lane] = values[lane]


@ti.func
def store_rows(
    particles: ti.template(), at, stride, first: ti.template(), count: ti.template(), rows: ti.template(), zero
):  # fmt: skip
    for r in range(count):
        start = bounded(at + (first + r) * stride, 1)
        values = lanes([overwrite(zero, particles[start + lane], rows[r, lane]) for lane in range(LANES)])
        for lane in ti.static(range(LANES)):
            particles[start + lane] = values[lane]


@ti.func
def three(rows: ti.template(), row: ti.template(), lane):
    return vec3(rows[row, lane], rows[row + 1, lane], rows[row + 2, lane])


@ti.func
def four(rows: ti.template(), row: ti.template(), lane, spare):
    """Four numbers of one lane. The write between them keeps LLVM from making a gather of them; spare: a row's number
    that the compiler does not know."""
    first = vec2(rows[row, lane], rows[row + 1, lane])
    rows[spare, lane] = first[0]
    return vec4(first[0], first[1], rows[row + 2, lane], rows[row + 3, lane])


@ti.func
def put(rows: ti.template(), row: ti.template(), lane, values: ti.template()):
    for d in ti.static(range(values.n)):
        rows[row + d, lane] = values[d]


@ti.func
def smallest_lane(rows: ti.template(), row: ti.template()):
    """Smallest number of a row of lanes."""
    least = rows[row, 0]
    for lane in ti.static(range(1, LANES)):
        least = ti.min(least, rows[row, lane])
    return least


@ti.func
def largest_lane(rows: ti.template(), row: ti.template()):
    """Largest number of a row of lanes."""
    most = rows[row, 0]
    for lane in ti.static(range(1, LANES)):
        most = ti.max(most, rows[row, lane])
    return most


@ti.func
def share_start(count, part, parts):
    """Where share `part` of `count` things begins; it ends where the next begins."""
    return count * part // parts


@ti.func
def part_range(count, part):
    """First of `count` things that a part does, and the one after its last; on a device a part is one thing."""
    if ti.static(ON_DEVICE):
        return part, part + 1
    else:
        return share_start(count, part, PARTS), share_start(count, part + 1, PARTS)


@ti.func
def slot_of(part):
    """Where in `partial` a part notes its sums."""
    if ti.static(ON_DEVICE):
        return part % PARTS
    else:
        return part


@ti.func
def copy_of(part):
    """Which copy a part scatters into."""
    if ti.static(ON_DEVICE):
        return 0
    else:
        return part


@ti.func
def add_to(array: ti.template(), at: ti.template(), value: ti.template()):
    """Adds to one entry of what a part scatters into."""
    if ti.static(ON_DEVICE):
        ti.atomic_add(array[at], value)
    else:
        array[at] = array[at] + value


@ti.func
def add_four(array: ti.template(), at, value):
    """Adds to four neighbours of what a part scatters into."""
    if ti.static(ON_DEVICE):
        for c in ti.static(range(4)):
            ti.atomic_add(array[at + c], value[c])
    else:
        start = bounded(at, 1)
        sums = vec4([array[start + c] + value[c] for c in range(4)])
        for c in ti.static(range(4)):
            array[start + c] = sums[c]

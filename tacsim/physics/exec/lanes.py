"""Vector lanes: how kernels are arranged so that the CPU works on eight neighbours at the same time.

Taichi's loops are scalar; LLVM merges eight equal scalar operations into one vector operation only if they are adjacent
and end in stores to adjacent addresses that were loaded before. Therefore arrays store one quantity of eight neighbours
(particles, elements, nodes; `lanes`) contiguously, and `overwrite` marks stores so that LLVM recognises them.

Work is divided into PARTS, independent of the number of threads: each part scatters into its own copy, and copies are
summed in a fixed order. So the CPU needs no atomics, and results have the same bits with any number of threads.

On a device (a GPU) the same functions run with one lane, and a part is one particle or node with its own thread; there
is one copy, and scattered values are added atomically. The switch is ON_DEVICE, which is known when a kernel is
compiled.
"""

import math
import platform
import re
from pathlib import Path

import numpy as np

from tacsim.compute.runtime import DEVICE, ti


def registers_of_four() -> bool:
    """Whether kernels have vector registers of four floats instead of eight: on ARM, and on AMD's CPUs after Zen 4.
    LLVM 15, the compiler of Taichi 1.7, does not support these and compiles for SSE2 (docs/decisions/0007)."""
    if platform.machine().lower() in ("arm64", "aarch64"):
        return True
    try:
        about = Path("/proc/cpuinfo").read_text()
    except OSError:  # not Linux
        return False
    family = re.search(r"^vendor_id\s*: AuthenticAMD\ncpu family\s*: (\d+)$", about, re.MULTILINE)
    return family is not None and int(family[1]) > 25


ON_DEVICE = DEVICE != "cpu"
LANES = 1 if ON_DEVICE else 8  # floats in a vector register of AVX2; on a GPU the threads are the lanes
PARTS = 4  # of an environment's work on the CPU; of its sums on all devices
CACHE_LINE = 16  # floats
MAX_NUMBERS = 2**30  # largest number of values in an array of kernels
COPIES = 1 if ON_DEVICE else PARTS  # of arrays that parts scatter into

# Neighbours along a line of the body's grid that share one vector register: a strip
NODES = 1 if ON_DEVICE or registers_of_four() else 2

vec2 = ti.types.vector(2, ti.f32)
vec3 = ti.types.vector(3, ti.f32)
vec4 = ti.types.vector(4, ti.f32)
ivec3 = ti.types.vector(3, ti.i32)
lanes = ti.types.vector(LANES, ti.f32)  # one number of LANES neighbours
strip = ti.types.vector(4 * NODES, ti.f32)  # four numbers of each of NODES neighbours


def round_up_to_lanes(n: int) -> int:
    """n rounded up to whole lanes."""
    return -(-n // LANES) * LANES


def aligned_zeros(*shape: int) -> np.ndarray:
    """float32 zeros that begin at a cache line, so that no vector crosses two cache lines.

    Raises MemoryError for more than MAX_NUMBERS values, the limit of kernels (see `bounded`): 4 GB.
    """
    count = math.prod(shape)
    if count > MAX_NUMBERS:
        raise MemoryError(
            f"an array of {count:,} numbers, the limit of kernels is {MAX_NUMBERS:,}: use a coarser "
            f"preset, or fewer worlds a batch"
        )
    memory = np.zeros(count + CACHE_LINE, np.float32)
    start = -memory.ctypes.data // 4 % CACHE_LINE
    return memory[start : start + count].reshape(shape)


@ti.func
def filled(value, rows: ti.template(), columns: ti.template()):
    """A matrix (rows, columns) with one value. Replaces Matrix.zero, in which each zero is a separate constant:
    Taichi's time to compile grows with the square of the number of constants (docs/decisions/0017)."""
    return ti.Matrix(ti.static([[value] * columns] * rows))


@ti.func
def overwrite(zero, old, new):
    """Returns `new`. `old` has no effect (`zero` is 0, which the compiler does not know): LLVM merges stores to
    addresses that have just been read."""
    if ti.static(ON_DEVICE):
        return new
    else:
        return ti.bit_cast(ti.bit_cast(new, ti.i32) | (ti.bit_cast(old, ti.i32) & zero), ti.f32)


@ti.func
def hide_from_compiler(zero, index):
    """Returns `index`. Otherwise the compiler would split a sum of indices and not find neighbours."""
    return index | zero


@ti.func
def bounded(index, width: ti.template()):
    """Returns `index` of an item with `width` numbers. It shows the compiler that the index is neither negative nor
    large, so that the compiler finds neighbours."""
    if ti.static(ON_DEVICE):
        return index
    else:
        return index & (MAX_NUMBERS // width - 1)


@ti.func
def load_lanes(array: ti.template(), at):
    """LANES neighbours from index `at`."""
    start = bounded(at, 1)
    return lanes([array[start + lane] for lane in range(LANES)])


@ti.func
def store_lanes(array: ti.template(), at, values, zero):
    start = bounded(at, 1)
    kept = lanes([overwrite(zero, array[start + lane], values[lane]) for lane in range(LANES)])
    for lane in ti.static(range(LANES)):
        array[start + lane] = kept[lane]


@ti.func
def load_strip(array: ti.template(), at):
    """The numbers of a strip of nodes, from index `at`."""
    start = bounded(at, 1)
    return strip([array[start + c] for c in range(4 * NODES)])


@ti.func
def store_strip(array: ti.template(), at, values, zero):
    start = bounded(at, 1)
    kept = strip([overwrite(zero, array[start + c], values[c]) for c in range(4 * NODES)])
    for c in ti.static(range(4 * NODES)):
        array[start + c] = kept[c]


@ti.func
def tile_vector(a):
    """A strip with a vector of four for every node."""
    return strip([a[c % 4] for c in range(4 * NODES)])


@ti.func
def tile_numbers(first, second):
    """A strip with the numbers of its nodes, each four times."""
    return strip([(first, second)[c // 4] for c in range(4 * NODES)])


@ti.func
def mask_strip(condition, numbers):
    """The numbers of a strip where those of another one are not 0, else 0."""
    return strip([ti.select(condition[c] != 0.0, numbers[c], 0.0) for c in range(4 * NODES)])


@ti.func
def load_rows(particles: ti.template(), at, stride, first: ti.template(), count: ti.template(), rows: ti.template()):
    """Loads `count` rows of a block of LANES particles, beginning with row `first`. In short loops: LLVM would split a
    longer one across the rows and gather."""
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
def read_three(rows: ti.template(), row: ti.template(), lane):
    return vec3(rows[row, lane], rows[row + 1, lane], rows[row + 2, lane])


@ti.func
def read_four(rows: ti.template(), row: ti.template(), lane, spare):
    """Four numbers of one lane. The write between the reads prevents LLVM from gathering; spare: number of a row, not
    known to the compiler."""
    first = vec2(rows[row, lane], rows[row + 1, lane])
    rows[spare, lane] = first[0]
    return vec4(first[0], first[1], rows[row + 2, lane], rows[row + 3, lane])


@ti.func
def write_rows(rows: ti.template(), row: ti.template(), lane, values: ti.template()):
    for d in ti.static(range(values.n)):
        rows[row + d, lane] = values[d]


@ti.func
def min_over_lanes(rows: ti.template(), row: ti.template()):
    """Smallest number of a row of lanes."""
    smallest = rows[row, 0]
    for lane in ti.static(range(1, LANES)):
        smallest = ti.min(smallest, rows[row, lane])
    return smallest


@ti.func
def max_over_lanes(rows: ti.template(), row: ti.template()):
    """Largest number of a row of lanes."""
    largest = rows[row, 0]
    for lane in ti.static(range(1, LANES)):
        largest = ti.max(largest, rows[row, lane])
    return largest


@ti.func
def share_start(count, part, parts):
    """First of `count` items in part number `part` of `parts`; a part ends where the next begins."""
    return count * part // parts


@ti.func
def part_range(count, part):
    """First of `count` items of a part, and the one after its last; on a device a part is one item."""
    if ti.static(ON_DEVICE):
        return part, part + 1
    else:
        return share_start(count, part, PARTS), share_start(count, part + 1, PARTS)


@ti.func
def slot_of(part):
    """Index in `partial` at which a part records its sums."""
    if ti.static(ON_DEVICE):
        return part % PARTS
    else:
        return part


@ti.func
def copy_of(part):
    """Number of the copy that a part scatters into."""
    if ti.static(ON_DEVICE):
        return 0
    else:
        return part


@ti.func
def add_to(array: ti.template(), at: ti.template(), value: ti.template()):
    """Adds to one entry of an array that a part scatters into."""
    if ti.static(ON_DEVICE):
        ti.atomic_add(array[at], value)
    else:
        array[at] = array[at] + value


@ti.func
def add_four(array: ti.template(), at, value):
    """Adds to four neighbouring entries of an array that a part scatters into."""
    if ti.static(ON_DEVICE):
        for c in ti.static(range(4)):
            ti.atomic_add(array[at + c], value[c])
    else:
        start = bounded(at, 1)
        sums = vec4([array[start + c] + value[c] for c in range(4)])
        for c in ti.static(range(4)):
            array[start + c] = sums[c]

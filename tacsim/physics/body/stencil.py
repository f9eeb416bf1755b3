"""Grid nodes that a particle interacts with, and their weights: quadratic B-splines over 3 x 3 x 3 nodes."""

from typing import Any, NamedTuple

from tacsim.compute.runtime import ti
from tacsim.physics.exec import layout
from tacsim.physics.exec.lanes import NODES, copy_of, vec3

LINE = 2 if NODES == 2 else 3  # strips that hold three neighbours

# Rows of the local arrays of a block of particles, LANES numbers each
_rows = layout.Layout()
OFFSET_ROW = _rows.place(3)  # offset of the particle from the stencil's first node; along z from its first strip
W_X, W_Y, W_Z = _rows.place(3), _rows.place(3), _rows.place(NODES * LINE)  # weights by axis
STENCIL = _rows.size
# Integers: the first strip of each of the stencil's 9 lines along z, then two flags
_indices = layout.Layout()
_indices.place(9)
OFF_GRID_INDEX, LARGE_STRAIN_INDEX = _indices.place(), _indices.place()  # off the grid; needs `return_any_strain`
INDICES = _indices.size


class Slab(NamedTuple):
    """Inside a kernel: the slab of the grid that a part's particles lie in."""

    origin: Any  # of node (0, 0, 0) [mm]
    scale: Any  # 1 / grid spacing
    low: Any  # first plane of nodes
    high: Any  # the one after the last
    ny: Any
    nz: Any
    base: Any  # index at which the grid begins in an array of strips
    discard: Any  # index at which three planes after the grid begin, which are never read


@ti.func
def slab_of(env: ti.template(), part, base):
    copy = copy_of(part)
    ny, nz = env.count(layout.GRID + 1), env.count(layout.GRID + 2)
    low, high = env.count(layout.SLAB + 2 * copy), env.count(layout.SLAB + 2 * copy + 1)
    discard = base + env.count(layout.GRID) * ny * (nz // NODES)
    origin, scale = env.param3(layout.ORIGIN), 1.0 / env.param(layout.BODY_CELL)
    return ti.static(Slab(origin, scale, low, high, ny, nz, base, discard))


@ti.func
def write_stencil(x, slab: ti.template(), rows: ti.template(), indices: ti.template(), lane):
    """Writes the stencil of one particle into `rows` and `indices`. Off the slab (or NaN), its lines are at
    `slab.discard`."""
    s = (x - slab.origin) * slab.scale
    ny, nz = slab.ny, slab.nz
    wanted = ti.floor(s - 0.5).cast(ti.i32)
    lowest, highest = ti.Vector([slab.low, 0, 0]), ti.Vector([slab.high - 3, ny - 3, nz - 3])
    first = ti.max(lowest, ti.min(wanted, highest))  # always a valid index
    off = (
        ti.select(wanted[0] == first[0], 0, 1)
        | ti.select(wanted[1] == first[1], 0, 1)
        | ti.select(wanted[2] == first[2], 0, 1)
    )
    shift = first[2] & (NODES - 1)  # nodes of the first strip before the stencil
    f = s - first.cast(ti.f32)
    # nodes 0, 1, 2, with a zero before and after them
    w = [vec3(0.0), 0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2, vec3(0.0)]
    rows[OFFSET_ROW, lane], rows[OFFSET_ROW + 1, lane], rows[OFFSET_ROW + 2, lane] = (
        f[0],
        f[1],
        f[2] + ti.cast(shift, ti.f32),
    )
    for i in ti.static(range(3)):
        rows[W_X + i, lane] = w[i + 1][0]
        rows[W_Y + i, lane] = w[i + 1][1]
    for n in ti.static(range(NODES * LINE)):
        rows[W_Z + n, lane] = ti.select(shift == 0, w[n + 1][2], w[n][2])
    row, at = nz // NODES, (first[0] * ny + first[1]) * (nz // NODES) + first[2] // NODES
    at = ti.select(off == 0, slab.base + at, slab.discard)
    for i, j in ti.static(ti.ndrange(3, 3)):
        indices[3 * i + j, lane] = at + (i * ny + j) * row
    indices[OFF_GRID_INDEX, lane] = off

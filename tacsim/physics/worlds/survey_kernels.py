"""Kernels that inspect states on a device, and that store copies of them there."""

from typing import Any

from tacsim.compute.runtime import ti
from tacsim.physics.body.transfers import Strips
from tacsim.physics.contact.contact import ContactHistory
from tacsim.physics.exec import layout
from tacsim.physics.exec.environment import Counts, Floats, Params
from tacsim.physics.exec.graph import Graph
from tacsim.physics.exec.lanes import vec3
from tacsim.physics.worlds.survey import (
    BLOCKS,
    CORNER,
    HIGH,
    LARGEST_SQUARED_VOLUME,
    LOW,
    MIN_EDGE,
    MOMENTS,
    MOVED,
    MOVED_REFERENCE,
    NODE_SPEED,
    NOT_FINITE,
    NUMBERS,
    REFERENCE,
    REFERENCE_SECOND,
    SECOND,
    SQUARED_VOLUME,
    SUMS,
    TOP,
)

Sums = ti.types.ndarray(dtype=ti.f32, ndim=3)  # (environments, numbers, BLOCKS)


@ti.func
def is_not_finite(value):
    """1 for a number that is not finite. It tests the bits, since compilers may assume finite numbers."""
    return ti.select((ti.bit_cast(value, ti.i32) & 0x7F800000) == 0x7F800000, 1, 0)


@ti.func
def note_min(found: ti.template(), e, number, value):
    if value < found[e, number]:  # a write would block other threads
        ti.atomic_min(found[e, number], value)


@ti.func
def note_max(found: ti.template(), e, number, value):
    if value > found[e, number]:
        ti.atomic_max(found[e, number], value)


@ti.func
def count_non_finite(found: ti.template(), e, count):
    if count > 0:
        ti.atomic_add(found[e, NOT_FINITE], float(count))


@ti.func
def node_vector(nodes: ti.template(), at, axis):
    return vec3(nodes[at], nodes[at + axis], nodes[at + 2 * axis])


@ti.kernel
def begin_survey(found: Params):
    for e, n in ti.ndrange(found.shape[0], NUMBERS):
        least = n >= LOW and n < HIGH
        for number in ti.static((MIN_EDGE, MIN_EDGE + 1, CORNER, SQUARED_VOLUME)):
            least = least or n == number
        most = (n >= HIGH and n < SUMS) or n == LARGEST_SQUARED_VOLUME
        for g in ti.static(range(2)):
            least = least or n == TOP + 4 * g + 2
            most = most or n == TOP + 4 * g + 3
        found[e, n] = ti.select(least, 1e9, ti.select(most, -1e9, 0.0))


@ti.kernel
def survey_gels(
    found: Params, nodes: Floats, surface: Floats, params: Params, counts: Counts, layers: ti.i32, columns: ti.i32,
    gels: ti.i32,
):  # fmt: skip
    """layers: of the thickest gel; columns: of nodes of all `gels` of an environment. A node's element is the one whose
    first node it is."""
    for e, k, column in ti.ndrange(counts.shape[0], layers + 1, columns):
        first = (counts[e, layout.ELEMENTS] + 1) * (counts[e, layout.ELEMENTS + 1] + 1)  # columns of gel 0
        g = ti.select(gels > 1 and column >= first, 1, 0)
        n = column - g * first
        nx, ny, nz = [counts[e, layout.ELEMENTS + 3 * g + d] for d in range(3)]
        row, layer = ny + 1, (nx + 1) * (ny + 1)
        axis = (nz + 1) * layer
        if k <= nz:
            at = counts[e, layout.GEL_NODES + g] + k * layer + n
            i, j = n // row, n % row
            bad = 0
            for d in range(6):  # displacement, velocity
                bad += is_not_finite(nodes[at + d * axis])
            count_non_finite(found, e, bad)
            u, v = node_vector(nodes, at, axis), node_vector(nodes, at + 3 * axis, axis)
            note_max(found, e, NODE_SPEED, ti.abs(v).max())
            if i < nx:
                note_min(found, e, MIN_EDGE + g, nodes[at + row] - u[0])
            if j < ny:
                note_min(found, e, MIN_EDGE + g, nodes[at + axis + 1] - u[1])
            if k < nz:
                note_min(found, e, MIN_EDGE + g, nodes[at + 2 * axis + layer] - u[2])
            else:
                carried = counts[e, layout.GEL_SURFACE + g] + 4 * ((i + 1) * (ny + 3) + j + 1) + 3
                count_non_finite(found, e, is_not_finite(surface[carried]))
                for d in ti.static(range(2)):
                    note_max(found, e, TOP + 4 * g + d, ti.abs(u[d]))
                note_min(found, e, TOP + 4 * g + 2, u[2])
                note_max(found, e, TOP + 4 * g + 3, u[2])
            if i < nx and j < ny and k < nz:
                h = params[e, layout.GEL_SPACING + g]
                p = [
                    [[node_vector(nodes, at + a * row + b + c * layer, axis) for c in range(2)] for b in range(2)]
                    for a in range(2)
                ]
                least = 1e9
                for a, b, c in ti.static(ti.ndrange(2, 2, 2)):
                    x = p[1][b][c] - p[0][b][c] + vec3(h, 0.0, 0.0)
                    y = p[a][1][c] - p[a][0][c] + vec3(0.0, h, 0.0)
                    z = p[a][b][1] - p[a][b][0] + vec3(0.0, 0.0, h)
                    least = ti.min(least, x.dot(y.cross(z)))
                note_min(found, e, CORNER, least / (h * h * h))


@ti.kernel
def survey_particles(
    found: Params, sums: Sums, particles: Floats, params: Params, counts: Counts
):  # fmt: skip
    """Sums of each block; `sum_blocks` adds the blocks. The base is layout.REFERENCE_CENTRE."""
    for e, block in ti.ndrange(counts.shape[0], BLOCKS):
        stride, count = counts[e, layout.STRIDE], counts[e, layout.PARTICLES]
        base = vec3([params[e, layout.REFERENCE_CENTRE + d] for d in range(3)])
        moved, reference, moved_reference = vec3(0.0), vec3(0.0), ti.Matrix.zero(ti.f32, 3, 3)
        square, cross, reference_square, reference_cross = vec3(0.0), vec3(0.0), vec3(0.0), vec3(0.0)
        low, high, volume, largest, bad = vec3(1e9), vec3(-1e9), 1e9, -1e9, 0
        for n in range((count - block + BLOCKS - 1) // BLOCKS):
            at = e * layout.PARTICLE_ROWS * stride + n * BLOCKS + block  # neighbouring threads read neighbours
            for r in range(layout.PARTICLE_ROWS):
                bad += is_not_finite(particles[at + r * stride])
            place = node_vector(particles, at + layout.REFERENCE * stride, stride)
            d = node_vector(particles, at + layout.POSITION * stride, stride) - place
            low, high = ti.min(low, place), ti.max(high, place)
            r = place - base
            x = r + d
            moved += d
            reference += r
            moved_reference += d.outer_product(r)
            square += x * x
            cross += vec3(x[0] * x[1], x[0] * x[2], x[1] * x[2])
            reference_square += r * r
            reference_cross += vec3(r[0] * r[1], r[0] * r[2], r[1] * r[2])
            diagonal = node_vector(particles, at + layout.STRAIN * stride, stride) + 1.0
            other = node_vector(particles, at + (layout.STRAIN + 3) * stride, stride)  # xy, xz, yz
            first = vec3(diagonal[0], other[0], other[1])
            middle = vec3(other[0], diagonal[1], other[2])
            squared = first.dot(middle.cross(vec3(other[1], other[2], diagonal[2])))
            volume, largest = ti.min(volume, squared), ti.max(largest, squared)
        count_non_finite(found, e, bad)
        note_min(found, e, SQUARED_VOLUME, volume)
        note_max(found, e, LARGEST_SQUARED_VOLUME, largest)
        for c in ti.static(range(3)):
            note_min(found, e, LOW + c, low[c])
            note_max(found, e, HIGH + c, high[c])
            sums[e, MOVED + c, block] = moved[c]
            sums[e, REFERENCE + c, block] = reference[c]
            sums[e, SECOND + c, block] = square[c]
            sums[e, SECOND + 3 + c, block] = cross[c]
            sums[e, REFERENCE_SECOND + c, block] = reference_square[c]
            sums[e, REFERENCE_SECOND + 3 + c, block] = reference_cross[c]
            for other_c in ti.static(range(3)):
                sums[e, MOVED_REFERENCE + 3 * c + other_c, block] = moved_reference[c, other_c]


@ti.kernel
def sum_blocks(found: Params, sums: Sums):
    for e, n in ti.ndrange(found.shape[0], MOMENTS):
        total = 0.0
        for block in range(BLOCKS):
            total += sums[e, n, block]
        found[e, SUMS + n] = total


def survey_of_entries(dtype: Any) -> Any:
    """A kernel that counts values that are not finite in an array (environments, _, _) of vectors or numbers."""
    array = ti.types.ndarray(dtype=dtype, ndim=3)
    width = getattr(dtype, "n", 0)

    @ti.kernel
    def survey_entries(found: Params, entries: array):
        for e, i, j in ti.ndrange(entries.shape[0], entries.shape[1], entries.shape[2]):
            bad = 0
            if ti.static(width == 0):
                bad = is_not_finite(entries[e, i, j])
            else:
                for c in ti.static(range(width)):
                    bad += is_not_finite(entries[e, i, j][c])
            count_non_finite(found, e, bad)

    return survey_entries


press_survey = Graph(
    begin_survey, survey_gels, (survey_of_entries(vec3), {"entries": "anchor"}),
    (survey_of_entries(ti.f32), {"entries": "pressure"}),
)  # fmt: skip
hybrid_survey = Graph(
    begin_survey,
    survey_gels,
    survey_particles,
    sum_blocks,
    (survey_of_entries(ContactHistory), {"entries": "histories"}),
)


@ti.kernel
def store_floats(
    first: ti.i32, last: ti.i32, resting: ti.i32, counts: Counts, source: Floats, target: Floats, margin: ti.i32
):  # fmt: skip
    """Copies environments `first` up to `last`: those that move; with `resting`, all. margin: numbers before those of
    the first environment and after those of the last."""
    each = (source.shape[0] - 2 * margin) // counts.shape[0]
    for e, n in ti.ndrange((first, last), each):
        if resting or counts[e, layout.STEPS] > 0:
            target[margin + e * each + n] = source[margin + e * each + n]


def store_entries(dtype: Any) -> Any:
    """The same for arrays (environments, _, _) of vectors or numbers."""
    array = ti.types.ndarray(dtype=dtype, ndim=3)

    @ti.kernel
    def store(first: ti.i32, last: ti.i32, resting: ti.i32, counts: Counts, source: array, target: array):
        for e, i, j in ti.ndrange((first, last), source.shape[1], source.shape[2]):
            if resting or counts[e, layout.STEPS] > 0:
                target[e, i, j] = source[e, i, j]

    return store


@ti.kernel
def store_strips(first: ti.i32, last: ti.i32, resting: ti.i32, counts: Counts, source: Strips, target: Strips):
    """The same for nodes of grids."""
    nodes = source.shape[0] // counts.shape[0]
    for e, n in ti.ndrange((first, last), nodes):
        if resting or counts[e, layout.STEPS] > 0:
            target[e * nodes + n] = source[e * nodes + n]


@ti.kernel
def copy_outer_rows(particles: Floats, outer: Sums):
    """Copies the rows of the particles' tangent planes and positions."""
    for e, r, p in ti.ndrange(outer.shape[0], outer.shape[1], outer.shape[2]):
        outer[e, r, p] = particles[(e * layout.PARTICLE_ROWS + r) * outer.shape[2] + p]


def _source_and_target(name: str, **more: str) -> dict[str, str]:
    return {"source": name, "target": f"stored_{name}", **more}


store_gels = (
    (store_floats, _source_and_target("nodes")),
    (store_floats, _source_and_target("surface", margin="no_margin")),
)
store_press = Graph(
    *store_gels,
    (store_entries(vec3), _source_and_target("anchor")),
    (store_entries(ti.f32), _source_and_target("pressure")),
)
store_hybrid = Graph(
    *store_gels, (store_floats, _source_and_target("particles", margin="no_margin")),
    (store_strips, _source_and_target("velocities")), (store_entries(ContactHistory), _source_and_target("histories")),
)  # fmt: skip

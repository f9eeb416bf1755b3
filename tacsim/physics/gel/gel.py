"""Elastic gel layer: total-Lagrangian trilinear hexahedra in the sensor's own frame, bonded to a rigid backing.

The lattice index k = 0 is the backing, k = nz the free surface (z = 0 of the sensor frame). The sensor may move in the
world; its gel does not notice. Inside: mm, N, MPa; density scaled so that the P-wave speed is 1.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tacsim.compute.runtime import ti
from tacsim.models.scene import Gel, GelSurface, lame
from tacsim.physics.exec.lanes import (
    COPIES,
    LANES,
    ON_DEVICE,
    PARTS,
    aligned_zeros,
    first_of,
    keep_or,
    lanes_at,
    least_lane,
    note_least,
    note_sum,
    opaque,
    padded,
    put_lanes,
    real,
    small,
    vec4,
)
from tacsim.physics.exec.layout import (
    BACKING,
    GEL_DAMPING,
    GEL_DENSITY,
    GEL_LAMBDA,
    GEL_MU,
    GEL_SPACING,
    NEVER,
    SMALLEST_VOLUME,
    STEP,
)
from tacsim.physics.gel.element import ROWS, SMALLEST, element_block

MM = 1e3  # millimetres in a metre
MPA = 1e-6  # megapascals in a pascal

# One axis each: kernels work out once where things begin. The compiler loses sight of neighbours in more axes.
Nodes = ti.types.ndarray(dtype=ti.f32, ndim=1)
Skin = ti.types.ndarray(dtype=ti.f32, ndim=1)
Touch = ti.types.ndarray(dtype=ti.f32, ndim=1)
Corners = ti.types.ndarray(dtype=ti.f32, ndim=1)
Lattice = ti.types.ndarray(dtype=real, ndim=1)


@dataclass(frozen=True)
class GelParams:
    """A gel's lattice and material in kernel units."""

    elements: tuple[int, int, int]
    spacing: float  # [mm]
    mu: float  # [MPa]
    lam: float  # [MPa]

    @property
    def density(self) -> float:
        """P-wave modulus: with it the P-wave speed is 1."""
        return self.lam + 2 * self.mu

    @property
    def thickness(self) -> float:
        return self.elements[2] * self.spacing

    @property
    def half(self) -> tuple[float, float]:
        return self.elements[0] * self.spacing / 2, self.elements[1] * self.spacing / 2

    def params(self) -> dict[int, float]:
        """Entries of the array `facts` (tacsim.physics.exec.layout)."""
        return {GEL_SPACING: self.spacing, GEL_MU: self.mu, GEL_LAMBDA: self.lam, GEL_DENSITY: self.density}


def gel_params(gel: Gel, element: float) -> GelParams:
    """Fits cubic elements of about `element` [m] into the gel, two of them or more along each axis.

    Raises ValueError if its sides do not fit one cube, or are narrower than two.
    """
    layers = max(2, round(gel.size[2] / element))
    spacing = gel.size[2] / layers
    for side in gel.size[:2]:
        if abs(round(side / spacing) * spacing - side) > 0.05 * spacing:
            raise ValueError(
                f"gel size {gel.size} m does not divide into cubes of {spacing * 1e3:.4g} mm (from its thickness); "
                f"choose element_size so that length, width and thickness are whole multiples of it"
            )
    nx, ny = (round(side / spacing) for side in gel.size[:2])
    if min(nx, ny) < 2:
        most = min(gel.size[:2]) / 2
        raise ValueError(
            f"gel size {gel.size} m makes {nx} x {ny} x {layers} elements of {spacing * 1e3:.4g} mm; its surface is a "
            f"spline and needs two along each axis: choose an element_size of at most {most * 1e3:.4g} mm"
        )
    mu, lam = lame(gel.material)
    return GelParams((nx, ny, layers), spacing * MM, mu * MPA, lam * MPA)


def one_lattice(gels: Sequence[GelParams]) -> GelParams:
    """What the gels of all environments share: how they are cut. Raises ValueError if they are not cut alike."""
    first = gels[0]
    for index, gel in enumerate(gels):
        if (gel.elements, gel.spacing) != (first.elements, first.spacing):
            raise ValueError(
                f"environments of a batch need one gel lattice: environment {index} has {_lattice_words(gel)}, "
                f"environment 0 {_lattice_words(first)}; give both the same gel.size, preset and element_size"
            )
    return first


def _lattice_words(gel: GelParams) -> str:
    nx, ny, nz = gel.elements
    return f"{nx} x {ny} x {nz} elements of {gel.spacing:.4g} mm"


class GelState:
    """Nodes of all gels of all environments, in the order that kernels like.

    nodes: (E, gels, 3, 3, nz + 1, P) displacement, velocity, force; axis; layer; the nodes of a layer as one row, node
    (i, j) at i (ny + 1) + j, zeros behind the last. One run of equal operations then covers a whole layer.
    skin: (E, gels, 2, nx + 3, ny + 3, 4) displacement and velocity of the surface, its rim repeated once outside.
    touch: (E, COPIES, gels, P, 4) contact force on the surface nodes, one copy a part; zeros between substeps.
    corners: (E, PARTS, 2, 24, W) forces of the elements of two layers on their corners: corner, axis. On a device,
    which works on all layers at once, (E, gels, nz, 24, W).
    lattice: (2, P) 1 at the first node of an element, else 0; and 1 / share of a node's mass, 0 where there is no node.
    """

    def __init__(self, params: GelParams, environments: int, gels: int) -> None:
        nx, ny, nz = params.elements
        row = ny + 1
        nodes = (nx + 1) * row
        width = padded(nodes)
        pieces = PARTS // gels
        blocks = -(-nodes // LANES)
        halo = -(-(row + 1) // LANES)
        longest = -(-blocks // pieces)
        self._row = row
        # Elements and nodes meet at offsets 0, 1, row and row + 1, so kernels read that far beyond both ends.
        self._nodes, self.nodes = shiftable((environments, gels, 3, 3, nz + 1, width), row + 1)
        self.skin = np.zeros((environments, gels, 2, nx + 3, ny + 3, 4), np.float32)
        self.touch = np.zeros((environments, COPIES, gels, width, 4), np.float32)
        cut = (gels, nz, 24, blocks + halo) if ON_DEVICE else (PARTS, 2, 24, (longest + halo) * LANES)
        self._corners, self.corners = shiftable((environments, *cut), row + 1)
        self.lattice = np.zeros((2, width), np.float32)
        whole = np.zeros((nx + 1, row), np.float32)
        whole[:-1, :-1] = 1.0
        share = np.full((nx + 1, row), 1.0, np.float32)
        share[[0, -1], :] *= 0.5
        share[:, [0, -1]] *= 0.5
        self.lattice[0, :nodes] = whole.ravel()
        self.lattice[1, :nodes] = 1.0 / share.ravel()
        self._shape = (nx + 1, row)

    def _view(self, quantity: int) -> np.ndarray:
        nx1, ny1 = self._shape
        flat = self.nodes[:, :, quantity, :, :, : nx1 * ny1]
        lattice = flat.reshape(*flat.shape[:-1], nx1, ny1)
        assert np.shares_memory(lattice, self.nodes)
        return lattice.transpose(0, 1, 4, 5, 3, 2)

    @property
    def u(self) -> np.ndarray:
        """Displacement [mm], (E, gels, nx + 1, ny + 1, nz + 1, 3), a view."""
        return self._view(0)

    @property
    def v(self) -> np.ndarray:
        """Velocity, (E, gels, nx + 1, ny + 1, nz + 1, 3), a view."""
        return self._view(1)

    @property
    def f(self) -> np.ndarray:
        """Force on the nodes in the last substep [N], (E, gels, nx + 1, ny + 1, nz + 1, 3), a view."""
        return self._view(2)

    def shortest(self, environment: int, spacing: float) -> float:
        """The shortest edge of an element [mm], each along its direction at rest, so one that has turned seems shorter
        than it is; NaN if a displacement is."""
        nx1, ny1 = self._shape
        flat = self.nodes[environment, :, 0, :, :, : nx1 * ny1]
        u = flat.reshape(*flat.shape[:-1], nx1, ny1)  # gel, axis, layer, i, j
        return spacing + min(float(np.diff(u[:, axis], axis=along).min()) for axis, along in ((0, 2), (1, 3), (2, 1)))

    def refresh(self) -> None:
        """The skin from the nodes, and zeros behind the last node: before a launch, since nodes may have been written.

        What stands behind the last node takes part in sums with weight 0, so it must be finite.
        """
        nx1, ny1 = self._shape
        self.nodes[..., nx1 * ny1 :] = 0.0
        for quantity in range(2):
            top = self._view(quantity)[..., -1, :]
            skin = self.skin[:, :, quantity, ..., :3]
            skin[:, :, 1:-1, 1:-1] = top
            skin[:, :, [0, -1], 1:-1] = top[:, :, [0, -1]]
            skin[:, :, :, [0, -1]] = skin[:, :, :, [1, -2]]

    def arguments(self) -> tuple[np.ndarray, ...]:
        """What every kernel with gels takes, in this order: nodes and corners with the margins round them."""
        return (
            self._nodes, self.skin.reshape(-1), self.touch.reshape(-1), self._corners, self.lattice.reshape(-1, LANES)
        )  # fmt: skip


def shiftable(shape: tuple[int, ...], margin: int) -> tuple[np.ndarray, np.ndarray]:
    """Zeros with `margin` more before and behind: the whole memory, and the array in its middle."""
    margin = padded(margin)
    memory = aligned_zeros(math.prod(shape) + 2 * margin)
    return memory, memory[margin:-margin].reshape(shape)


def gel_surface(params: GelParams, state: GelState, environment: int, gel: int) -> GelSurface:
    top = state.u[environment, gel, :, :, -1] / np.float32(MM)
    half = params.half
    return GelSurface(np.ascontiguousarray(top), params.spacing / MM, (-half[0] / MM, -half[1] / MM))


@ti.func
def skin_row(env, gels, g, nx):
    """First row of a gel's displacements in `skin`; its velocities begin nx + 3 rows further on."""
    return (env * gels + g) * 2 * (nx + 3)


@ti.func
def skin_at(row, column, ny):
    """Where the four numbers of a node stand in `skin`."""
    return small(4 * (row * (ny + 3) + column), 1)


@ti.func
def touch_start(env, copy, gels, g, nx, ny):
    """Where a gel's forces on its nodes begin in a copy of `touch`."""
    return ((env * COPIES + copy) * gels + g) * 4 * LANES * (((nx + 1) * (ny + 1) + LANES - 1) // LANES)


@ti.func
def margin(ny):
    """Numbers before the first of `nodes` and `corners`."""
    return (ny + 2 + LANES - 1) // LANES * LANES


@ti.func
def node_block(
    to, i, j, below, above, row, nodes: ti.template(), corners: ti.template(), across_j, across_i, never
):  # fmt: skip
    """Internal force on LANES nodes along one axis, from the elements above them, at i in `corners`, and below, at j.

    below, above: 1 or 0, whether there are any; row, across_j, across_i: as for `element_block`.
    """
    under, over = real(0.0), real(0.0)
    for p, q in ti.static(ti.ndrange(2, 2)):  # of the element that has these nodes as its corners p, q
        way = (12 * p + 6 * q) * row - p * across_i - q * across_j
        under += lanes_at(corners, i + way)
        over += lanes_at(corners, j + 3 * row + way)
    put_lanes(nodes, to, below * under + above * over, never)


@ti.func
def gel_forces(
    env, part, gels, nodes: ti.template(), corners: ti.template(), lattice: ti.template(), params: ti.template(),
    counts: ti.template(), partial: ti.template(), layers, nx, ny,
):  # fmt: skip
    """Internal forces on this part's nodes of its gel. A layer of elements, then the nodes below it, and so on up."""
    never = counts[env, NEVER]
    pieces = PARTS // gels
    g, piece = part // pieces, part % pieces
    blocks = ((nx + 1) * (ny + 1) + LANES - 1) // LANES
    first, last = first_of(blocks, piece, pieces), first_of(blocks, piece + 1, pieces)
    halo = (ny + 1 + LANES) // LANES  # blocks before `first` whose elements reach into it
    row = ((blocks + pieces - 1) // pieces + halo) * LANES  # of corners
    layer = blocks * LANES
    axis = (layers + 1) * layer
    u = margin(ny) + (env * gels + g) * 9 * axis
    rows = ti.Matrix.zero(ti.f32, ROWS, LANES)
    for lane in range(LANES):
        rows[SMALLEST, lane] = 1e9
    for k in range(layers + 1):
        here = margin(ny) + (2 * (env * PARTS + part) + k % 2) * 24 * row + (halo - first) * LANES
        before = margin(ny) + (2 * (env * PARTS + part) + (k + 1) % 2) * 24 * row + (halo - first) * LANES
        if k < layers:
            for block in range(ti.max(first - halo, 0), last):
                element_block(
                    env, u + k * layer + block * LANES, axis, layer, here + block * LANES, row, block, nodes, 1, ny + 1,
                    corners, lattice, params, rows, never,
                )  # fmt: skip
        below, above = ti.select(k < layers, 1.0, 0.0), ti.select(k > 0, 1.0, 0.0)
        for block in range(first, last):
            i, j = here + block * LANES, before + block * LANES
            for d in range(3):
                to = u + (6 + d) * axis + k * layer + block * LANES
                node_block(to, i + d * row, j + d * row, below, above, row, nodes, corners, 1, ny + 1, never)
    note_least(partial, env, part, SMALLEST_VOLUME, least_lane(rows, SMALLEST))


@ti.func
def take_touch(env, gels, g, first, last, forces, axis, nodes: ti.template(), touch: ti.template(), never, nx, ny):
    """Adds the contact forces of all parts to those on a gel's surface nodes, `first` to `last` by blocks, and leaves
    zeros for the next substep. forces: where those along x begin, `axis` the way to y and z."""
    push = ti.Matrix.zero(ti.f32, 4 * LANES, 1)
    turned = ti.Matrix.zero(ti.f32, 4, LANES)
    for block in range(first, last):
        for c in range(4 * LANES):
            total = 0.0
            for copy in ti.static(range(COPIES)):
                total += touch[small(touch_start(env, copy, gels, g, nx, ny) + block * 4 * LANES, 1) + c]
            push[c, 0] = total
        for lane in range(LANES):
            for d in ti.static(range(4)):
                turned[d, lane] = push[4 * lane + d, 0]
        for d in ti.static(range(3)):
            at = forces + d * axis + block * LANES
            put_lanes(nodes, at, lanes_at(nodes, at) + real([turned[d, lane] for lane in range(LANES)]), never)
        for copy in ti.static(range(COPIES)):
            for quarter in range(4):
                at = touch_start(env, copy, gels, g, nx, ny) + (block * 4 + quarter) * LANES
                put_lanes(touch, at, real(0.0), never)


@ti.func
def gel_advance(
    env, part, gels, nodes: ti.template(), skin: ti.template(), touch: ti.template(), lattice: ti.template(),
    params: ti.template(), counts: ti.template(), partial: ti.template(), layers, nx, ny,
):  # fmt: skip
    """Symplectic Euler with lumped masses on this part's nodes of its gel, and their skin.

    Damps the old velocity only, so that force readings stay exact. The force of this part on the backing is noted. On a
    device a part is one column of nodes: of gel part // columns, number part % columns.
    """
    never, dt, h = counts[env, NEVER], params[env, STEP], params[env, GEL_SPACING]
    pieces = PARTS // gels
    row, count = ny + 1, (nx + 1) * (ny + 1)
    blocks = (count + LANES - 1) // LANES
    g, piece = part // pieces, part % pieces
    slot, first, last = part, first_of(blocks, piece, pieces), first_of(blocks, piece + 1, pieces)
    if ti.static(ON_DEVICE):
        g, first = part // blocks, part % blocks
        slot, last = g * pieces + first % pieces, first + 1
    layer = blocks * LANES
    axis = (layers + 1) * layer
    u = margin(ny) + (env * gels + g) * 9 * axis
    keep = 1.0 - params[env, GEL_DAMPING] * dt
    rate = dt / (params[env, GEL_DENSITY] * h * h * h)
    for d in ti.static(range(3)):
        held = real(0.0)
        for block in range(first, last):
            force = lanes_at(nodes, u + (6 + d) * axis + block * LANES)
            held += ti.select(lattice[blocks + block] > 0.0, force, 0.0)
        note_sum(partial, env, slot, BACKING + d, held.sum())
    top = u + layers * layer
    if ti.static(ON_DEVICE):
        for d in ti.static(range(3)):
            at = touch_start(env, 0, gels, g, nx, ny) + 4 * first + d
            nodes[top + (6 + d) * axis + first] += touch[at]
            touch[at] = 0.0
    else:
        take_touch(env, gels, g, first, last, top + 6 * axis, axis, nodes, touch, never, nx, ny)
    for k in range(1, layers + 1):
        scale = ti.select(k == layers, 2.0 * rate, rate)
        for block in range(first, last):
            share = lattice[opaque(never, blocks + block)] * scale
            for d in range(3):
                x = u + d * axis + k * layer + block * LANES
                v, f = x + 3 * axis, x + 6 * axis
                speed = keep * lanes_at(nodes, v) + share * lanes_at(nodes, f)
                place = lanes_at(nodes, x) + dt * speed
                put_lanes(nodes, v, speed, never)
                put_lanes(nodes, x, place, never)
    first_row = skin_row(env, gels, g, nx)
    i, j = first * LANES // row, first * LANES % row
    for block in range(first, last):
        for lane in range(ti.min(LANES, count - block * LANES)):
            p0, p1 = i + ti.select(i > 0, 1, 0), i + ti.select(i < nx, 2, 3)
            q0, q1 = j + ti.select(j > 0, 1, 0), j + ti.select(j < ny, 2, 3)
            for quantity in ti.static(range(2)):
                at = vec4(0.0)
                for d in ti.static(range(3)):
                    at[d] = nodes[top + (3 * quantity + d) * axis + block * LANES + lane]
                for p in range(p0, p1):
                    for q in range(q0, q1):
                        to = skin_at(first_row + quantity * (nx + 3) + p, q, ny)
                        values = vec4([keep_or(never, skin[to + c], at[c]) for c in range(4)])
                        for c in ti.static(range(4)):
                            skin[to + c] = values[c]
            j += 1
            if j == row:
                i, j = i + 1, 0

"""Elastic gel layer: total-Lagrangian trilinear hexahedra in the sensor's frame, bonded to a rigid backing.

The lattice index k = 0 is the backing, k = nz the free surface (z = 0 of the sensor frame). The sensor may move in the
world; this has no effect on the gel's equations. Its kernels: tacsim/physics/gel/kernels.py. Units: mm, N, MPa; density
scaled so that the P-wave speed is 1.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from tacsim.models.material import elastic_constants
from tacsim.models.scene import Gel, GelSurface
from tacsim.physics.exec.lanes import COPIES, LANES, ON_DEVICE, PARTS, aligned_zeros, round_up_to_lanes
from tacsim.physics.exec.layout import (
    ELEMENTS,
    GEL_CORNERS,
    GEL_DENSITY,
    GEL_FORCES,
    GEL_LAMBDA,
    GEL_LATTICE,
    GEL_MU,
    GEL_NODES,
    GEL_SPACING,
    GEL_SURFACE,
)
from tacsim.physics.snapshot import SENSORS, gel_suffixes
from tacsim.physics.units import MM, MPA

QUANTITIES = 6  # of a node
LATTICE_ROWS = 6


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

    def rim_points(self, z: float, count: int) -> np.ndarray:
        """(4 count, 3) around the gel at a height [mm]."""
        return _rim_points(self.half, z, count)

    def params(self, index: int = 0) -> dict[int, float]:
        """Entries of the array `params` (tacsim.physics.exec.layout), of an environment's gel number `index`."""
        entries = {GEL_SPACING: self.spacing, GEL_MU: self.mu, GEL_LAMBDA: self.lam, GEL_DENSITY: self.density}
        return {entry + index: value for entry, value in entries.items()}


def gel_params(gel: Gel, element: float) -> GelParams:
    """Fits cubic elements of about `element` [m] into the gel, two of them or more along each axis.

    Raises ValueError if its sides are no multiples of the cube, or have fewer than two cubes.
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
        max_size = min(gel.size[:2]) / 2
        raise ValueError(
            f"gel size {gel.size} m gives {nx} x {ny} x {layers} elements of {spacing * 1e3:.4g} mm; the spline of its "
            f"surface needs two along each axis: choose an element_size of at most {max_size * 1e3:.4g} mm"
        )
    mu, lam = elastic_constants(gel.material)
    return GelParams((nx, ny, layers), spacing * MM, mu * MPA, lam * MPA)


@lru_cache(maxsize=8)
def _rim_points(half: tuple[float, float], z: float, count: int) -> np.ndarray:
    share = np.linspace(-1.0, 1.0, count)
    sides = [np.stack([share, np.full(count, s)], axis=1) for s in (-1.0, 1.0)]
    rim = np.concatenate([*sides, *(side[:, ::-1] for side in sides)]) * half
    return np.insert(rim, 2, z, axis=1)


def common_lattices(worlds: Sequence[Sequence[GelParams]]) -> Sequence[GelParams]:
    """The lattice of each gel, which all environments share. Raises ValueError where two environments differ."""
    first = worlds[0]
    for index, gels in enumerate(worlds):
        for name, gel, other in zip(SENSORS, gels, first, strict=False):
            if (gel.elements, gel.spacing) != (other.elements, other.spacing):
                raise ValueError(
                    f"environments of a batch need one gel lattice: environment {index} has {_lattice_words(gel)}, "
                    f"environment 0 {_lattice_words(other)} (sensor '{name}'); give both the same gel.size, preset "
                    f"and element_size"
                )
    return first


def _lattice_words(gel: GelParams) -> str:
    nx, ny, nz = gel.elements
    return f"{nx} x {ny} x {nz} elements of {gel.spacing:.4g} mm"


class GelGroup:
    """Views of gels of all environments that have equal lattices: all gels of an environment, or one.

    nodes: (E, gels, QUANTITIES, 3, nz + 1, P) displacement, velocity, force, and the stages of the filter of
    accelerations (tacsim/physics/gel/mass.py); axis; layer; the nodes of a layer as one row, node (i, j) at
    i (ny + 1) + j, zeros after the last. So a loop of equal operations covers a whole layer.
    surface: (E, gels, 2, nx + 3, ny + 3, 4) displacement and velocity of the surface, its rim repeated once outside;
    after a displacement, the stored pressure of the node under an indenter [MPa].
    contact_force: (E, gels, COPIES, P, 4) on the surface nodes, one copy a part; zeros between substeps.
    u, v, f: displacement [mm], velocity, and force in the last substep [N], (E, gels, nx + 1, ny + 1, nz + 1, 3).
    """

    def __init__(self, params: GelParams, nodes: np.ndarray, surface: np.ndarray, contact_force: np.ndarray) -> None:
        nx, ny, _ = params.elements
        self.params, self.nodes, self.surface, self.contact_force = params, nodes, surface, contact_force
        self._shape = (nx + 1, ny + 1)
        self.u, self.v, self.f = (self._view(quantity) for quantity in range(3))

    def _view(self, quantity: int) -> np.ndarray:
        nx1, ny1 = self._shape
        flat = self.nodes[:, :, quantity, :, :, : nx1 * ny1]
        lattice = flat.reshape(*flat.shape[:-1], nx1, ny1)
        assert np.shares_memory(lattice, self.nodes)
        return lattice.transpose(0, 1, 4, 5, 3, 2)

    @property
    def surface_pressure(self) -> np.ndarray:
        """Stored pressure of the surface nodes [MPa], (E, gels, nx + 1, ny + 1), a view."""
        return self.surface[:, :, 0, 1:-1, 1:-1, 3]

    def min_edge_length(self, environment: int) -> float:
        """Shortest edge of an element [mm], each measured along its direction at rest: a lower bound for rotated edges;
        NaN if a displacement is NaN."""
        nx1, ny1 = self._shape
        flat = self.nodes[environment, :, 0, :, :, : nx1 * ny1]
        u = flat.reshape(*flat.shape[:-1], nx1, ny1)  # gel, axis, layer, i, j
        edges = u[:, 0, :, 1:] - u[:, 0, :, :-1], u[:, 1, ..., 1:] - u[:, 1, ..., :-1], u[:, 2, 1:] - u[:, 2, :-1]
        return self.params.spacing + min(float(edge.min()) for edge in edges)

    def is_slow_and_finite(self, environment: int, max_speed: float) -> bool:
        """Whether all displacements and velocities are finite and no velocity component is above `max_speed`."""
        moving = self.nodes[environment, :, :2]
        return bool(np.isfinite(moving).all()) and bool(np.abs(moving[:, 1]).max() <= max_speed)

    def copy_surface(self, environment: int | slice = slice(None)) -> None:
        """See GelState."""
        nx1, ny1 = self._shape
        self.nodes[environment, ..., nx1 * ny1 :] = 0.0
        for quantity, nodes in enumerate((self.u, self.v)):
            surface = self.surface[environment, :, quantity]
            surface[..., 1:-1, 1:-1, :3] = nodes[environment, ..., -1, :]
            surface[..., [0, -1], 1:-1, :] = surface[..., [1, -2], 1:-1, :]
            surface[..., [0, -1], :] = surface[..., [1, -2], :]


class GelState:
    """Nodes of all gels of all environments, arranged for the kernels: each array has all environments, one after the
    other, and in each its gels with their own shapes. `write_layout` gives the kernels the index of each.

    gels: of an environment. groups: views of gels with equal lattices.
    corners: for each environment, gel and part of it (2, 24, W) forces of the elements of two layers on their corners:
    corner, axis. On a device, which works on all layers at once, for each environment and gel (nz, 24, W).
    lattice: for each group (LATTICE_ROWS, P) 1 at the first node of an element, else 0; 1 / share of a node's mass, 0
    where there is no node; weights of its neighbours before and after it along x, and along y, in a mean over the
    elements around it.
    """

    def __init__(self, gels: Sequence[GelParams], environments: int) -> None:
        self.gels, first = tuple(gels), gels[0]
        alike = all((gel.elements, gel.spacing) == (first.elements, first.spacing) for gel in gels)
        grouped = [(first, len(gels))] if alike else [(gel, 1) for gel in gels]
        # The nodes of an element have offsets 0, 1, row and row + 1: kernels read so far beyond both ends.
        self.margin = round_up_to_lanes(max(gel.elements[1] for gel in gels) + 2)
        self._nodes, nodes, node_starts = _allocate(_node_shape, grouped, environments, self.margin)
        self._surface, surfaces, surface_starts = _allocate(_surface_shape, grouped, environments)
        self._forces, forces, force_starts = _allocate(_force_shape, grouped, environments)
        corner_shape = partial(_corner_shape, PARTS // len(gels))
        self._corners, _, corner_starts = _allocate(corner_shape, grouped, environments, self.margin)
        self.groups = tuple(
            GelGroup(params, *views) for (params, _), *views in zip(grouped, nodes, surfaces, forces, strict=True)
        )
        rows = [_lattice_rows(params) for params, _ in grouped]
        self._lattice = np.concatenate([each.reshape(-1, LANES) for each in rows])
        firsts = np.cumsum([0, *(each.size // LANES for each in rows)])
        lattice_starts = [first for first, (_, number) in zip(firsts, grouped, strict=False) for _ in range(number)]
        self._starts = {
            GEL_NODES: node_starts, GEL_SURFACE: surface_starts, GEL_FORCES: force_starts, GEL_CORNERS: corner_starts,
            GEL_LATTICE: lattice_starts,
        }  # fmt: skip

    def write_layout(self, counts: np.ndarray) -> None:
        """Writes the lattice of each gel and its first indices in the arrays into the counts (E, COUNTS)."""
        for g, gel in enumerate(self.gels):
            counts[:, ELEMENTS + 3 * g : ELEMENTS + 3 * g + 3] = gel.elements
            for entry, starts in self._starts.items():
                counts[:, entry + g] = starts[g]

    @property
    def common_group(self) -> GelGroup:
        """The only group, for gels with equal lattices."""
        (group,) = self.groups
        return group

    @property
    def columns(self) -> int:
        """Number of node columns of all gels of an environment."""
        return sum((gel.elements[0] + 1) * (gel.elements[1] + 1) for gel in self.gels)

    def arrays(self, environment: int) -> dict[str, np.ndarray]:
        """Views of the arrays that a motion changes, by name (see tacsim.physics.snapshot.gel_suffixes)."""
        names = gel_suffixes(len(self.groups))
        views = {f"gel_displacement{name}": each.u[environment] for name, each in zip(names, self.groups, strict=True)}
        return views | {
            f"gel_velocity{name}": each.v[environment] for name, each in zip(names, self.groups, strict=True)
        }

    def surface_displacements(self, environment: int) -> list[np.ndarray]:
        """Displacements of an environment's gel surfaces [mm], each (nx + 1, ny + 1, 3)."""
        return [top for group in self.groups for top in group.u[environment, :, :, :, -1]]

    def min_edge_length(self, environment: int) -> list[float]:
        """`GelGroup.min_edge_length` of each group."""
        return [group.min_edge_length(environment) for group in self.groups]

    def clear(self, environment: int, *, velocity_only: bool = False) -> None:
        """Sets all velocities to zero, and all displacements unless `velocity_only`."""
        for group in self.groups:
            group.v[environment] = 0.0
            if not velocity_only:
                group.u[environment] = 0.0

    def is_slow_and_finite(self, environment: int, max_speed: float) -> bool:
        """See `GelGroup.is_slow_and_finite`."""
        return all(group.is_slow_and_finite(environment, max_speed) for group in self.groups)

    def copy_surface(self, environment: int | slice = slice(None)) -> None:
        """Copies the nodes' top layer and its rim to `surface`, of one environment or of all. Called before a launch,
        since users may write to `nodes`.

        Writes zeros after the last node: these entries are in sums with weight 0, so they must be finite.
        """
        for group in self.groups:
            group.copy_surface(environment)

    def arguments(self) -> tuple[np.ndarray, ...]:
        """Arguments of every kernel with gels, in this order: nodes and corners with their margins."""
        return self._nodes, self._surface, self._forces, self._corners, self._lattice


def _node_shape(gel: GelParams) -> tuple[int, ...]:
    nx, ny, nz = gel.elements
    return QUANTITIES, 3, nz + 1, round_up_to_lanes((nx + 1) * (ny + 1))


def _surface_shape(gel: GelParams) -> tuple[int, ...]:
    nx, ny, _ = gel.elements
    return 2, nx + 3, ny + 3, 4


def _force_shape(gel: GelParams) -> tuple[int, ...]:
    nx, ny, _ = gel.elements
    return COPIES, round_up_to_lanes((nx + 1) * (ny + 1)), 4


def _corner_shape(pieces: int, gel: GelParams) -> tuple[int, ...]:
    """pieces: parts that share a gel."""
    nx, ny, nz = gel.elements
    blocks, halo = round_up_to_lanes((nx + 1) * (ny + 1)) // LANES, round_up_to_lanes(ny + 2) // LANES
    return (nz, 24, blocks + halo) if ON_DEVICE else (pieces, 2, 24, (-(-blocks // pieces) + halo) * LANES)


def _allocate(
    shape_of: Callable[[GelParams], tuple[int, ...]], grouped: Sequence[tuple[GelParams, int]], environments: int,
    margin: int = 0,
) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:  # fmt: skip
    """Zeros for an array of each gel of each environment: the whole memory, with `margin` more numbers before and after
    it; a view of each group (environments, gels, *shape); first index of each gel, (environments,)."""
    shapes = [shape_of(params) for params, _ in grouped]
    each = sum(number * math.prod(shape) for (_, number), shape in zip(grouped, shapes, strict=True))
    memory = aligned_zeros(environments * each + 2 * margin)
    inside = memory[margin : margin + environments * each].reshape(environments, each)
    views, starts, first = [], [], 0
    for (_, number), shape in zip(grouped, shapes, strict=True):
        size = math.prod(shape)
        views.append(inside[:, first : first + number * size].reshape(environments, number, *shape))
        starts += [margin + first + g * size + each * np.arange(environments) for g in range(number)]
        first += number * size
    return memory, views, starts


def _lattice_rows(gel: GelParams) -> np.ndarray:
    """(LATTICE_ROWS, P) of GelState.lattice."""
    nx, ny, _ = gel.elements
    nodes, row = (nx + 1) * (ny + 1), ny + 1
    lattice = np.zeros((LATTICE_ROWS, round_up_to_lanes(nodes)), np.float32)
    whole = np.zeros((nx + 1, row), np.float32)
    whole[:-1, :-1] = 1.0
    share = np.full((nx + 1, row), 1.0, np.float32)
    share[[0, -1], :] *= 0.5
    share[:, [0, -1]] *= 0.5
    lattice[0, :nodes] = whole.ravel()
    lattice[1, :nodes] = 1.0 / share.ravel()
    for axis in (0, 1):
        weights = np.full((2, nx + 1, row), 0.25, np.float32)  # before, after
        ends = np.moveaxis(weights, 1 + axis, 0)
        ends[0], ends[-1] = np.array([[[0.0], [0.5]], [[0.5], [0.0]]])
        lattice[2 + 2 * axis : 4 + 2 * axis, :nodes] = weights.reshape(2, nodes)
    return lattice


def gel_surface(params: GelParams, top: np.ndarray) -> GelSurface:
    """The surface with node displacements `top` (nx + 1, ny + 1, 3) [mm]."""
    half = params.half
    return GelSurface(np.ascontiguousarray(top / np.float32(MM)), params.spacing / MM, (-half[0] / MM, -half[1] / MM))

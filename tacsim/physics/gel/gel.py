"""Elastic gel layer: total-Lagrangian trilinear hexahedra in the sensor's own frame, bonded to a rigid backing.

The lattice index k = 0 is the backing, k = nz the free surface (z = 0 of the sensor frame). The sensor may move in the
world; its gel does not notice. Its kernels: tacsim/physics/gel/kernels.py. Inside: mm, N, MPa; density scaled so that
the P-wave speed is 1.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tacsim.models.scene import Gel, GelSurface, lame
from tacsim.physics.exec.lanes import COPIES, LANES, ON_DEVICE, PARTS, aligned_zeros, padded
from tacsim.physics.exec.layout import GEL_DENSITY, GEL_LAMBDA, GEL_MU, GEL_SPACING
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

    def params(self) -> dict[int, float]:
        """Entries of the array `params` (tacsim.physics.exec.layout)."""
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


def common_lattice(gels: Sequence[GelParams]) -> GelParams:
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
    """Nodes of all gels of all environments, laid out for the kernels.

    nodes: (E, gels, QUANTITIES, 3, nz + 1, P) displacement, velocity, force, and what their accelerations pass through
    (tacsim/physics/gel/mass.py); axis; layer; the nodes of a layer as one row, node
    (i, j) at i (ny + 1) + j, zeros behind the last. One run of equal operations then covers a whole layer.
    surface: (E, gels, 2, nx + 3, ny + 3, 4) displacement and velocity of the surface, its rim repeated once outside;
    behind a displacement the pressure that the node carries [MPa], under an indenter.
    contact_force: (E, COPIES, gels, P, 4) on the surface nodes, one copy a part; zeros between substeps.
    corners: (E, PARTS, 2, 24, W) forces of the elements of two layers on their corners: corner, axis. On a device,
    which works on all layers at once, (E, gels, nz, 24, W).
    lattice: (LATTICE_ROWS, P) 1 at the first node of an element, else 0; 1 / share of a node's mass, 0 where there is
    no node; weights of its neighbours before and after it along x, and along y, in a mean over the elements round it.
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
        self._nodes, self.nodes = with_margins((environments, gels, QUANTITIES, 3, nz + 1, width), row + 1)
        self.surface = np.zeros((environments, gels, 2, nx + 3, ny + 3, 4), np.float32)
        self.contact_force = np.zeros((environments, COPIES, gels, width, 4), np.float32)
        cut = (gels, nz, 24, blocks + halo) if ON_DEVICE else (PARTS, 2, 24, (longest + halo) * LANES)
        self._corners, self.corners = with_margins((environments, *cut), row + 1)
        self.lattice = np.zeros((LATTICE_ROWS, width), np.float32)
        whole = np.zeros((nx + 1, row), np.float32)
        whole[:-1, :-1] = 1.0
        share = np.full((nx + 1, row), 1.0, np.float32)
        share[[0, -1], :] *= 0.5
        share[:, [0, -1]] *= 0.5
        self.lattice[0, :nodes] = whole.ravel()
        self.lattice[1, :nodes] = 1.0 / share.ravel()
        for axis in (0, 1):
            weights = np.full((2, nx + 1, row), 0.25, np.float32)  # before, after
            ends = np.moveaxis(weights, 1 + axis, 0)
            ends[0], ends[-1] = np.array([[[0.0], [0.5]], [[0.5], [0.0]]])
            self.lattice[2 + 2 * axis : 4 + 2 * axis, :nodes] = weights.reshape(2, nodes)
        self._shape = (nx + 1, row)
        self._u, self._v, self._f = (self._view(quantity) for quantity in range(3))

    def _view(self, quantity: int) -> np.ndarray:
        nx1, ny1 = self._shape
        flat = self.nodes[:, :, quantity, :, :, : nx1 * ny1]
        lattice = flat.reshape(*flat.shape[:-1], nx1, ny1)
        assert np.shares_memory(lattice, self.nodes)
        return lattice.transpose(0, 1, 4, 5, 3, 2)

    @property
    def u(self) -> np.ndarray:
        """Displacement [mm], (E, gels, nx + 1, ny + 1, nz + 1, 3), a view."""
        return self._u

    @property
    def v(self) -> np.ndarray:
        """Velocity, (E, gels, nx + 1, ny + 1, nz + 1, 3), a view."""
        return self._v

    @property
    def f(self) -> np.ndarray:
        """Force on the nodes in the last substep [N], (E, gels, nx + 1, ny + 1, nz + 1, 3), a view."""
        return self._f

    @property
    def carried(self) -> np.ndarray:
        """Pressure that the surface nodes carry [MPa], (E, gels, nx + 1, ny + 1), a view."""
        return self.surface[:, :, 0, 1:-1, 1:-1, 3]

    def shortest(self, environment: int, spacing: float) -> float:
        """The shortest edge of an element [mm], each along its direction at rest, so one that has turned seems shorter
        than it is; NaN if a displacement is."""
        nx1, ny1 = self._shape
        flat = self.nodes[environment, :, 0, :, :, : nx1 * ny1]
        u = flat.reshape(*flat.shape[:-1], nx1, ny1)  # gel, axis, layer, i, j
        edges = u[:, 0, :, 1:] - u[:, 0, :, :-1], u[:, 1, ..., 1:] - u[:, 1, ..., :-1], u[:, 2, 1:] - u[:, 2, :-1]
        return spacing + min(float(edge.min()) for edge in edges)

    def quiet(self, environment: int, fastest: float) -> bool:
        """Whether all displacements and velocities are finite, and no component of a velocity beyond `fastest`."""
        moving = self.nodes[environment, :, :2]
        return bool(np.isfinite(moving).all()) and bool(np.abs(moving[:, 1]).max() <= fastest)

    def refresh(self) -> None:
        """Copies the nodes' top layer to `surface`, and its rim outside: before a launch, since all may be written.

        Writes zeros behind the last node: what stands there takes part in sums with weight 0, so it must be finite.
        """
        nx1, ny1 = self._shape
        self.nodes[..., nx1 * ny1 :] = 0.0
        for quantity, nodes in enumerate((self._u, self._v)):
            top = nodes[..., -1, :]
            surface = self.surface[:, :, quantity]
            surface[:, :, 1:-1, 1:-1, :3] = top
            surface[:, :, [0, -1], 1:-1] = surface[:, :, [1, -2], 1:-1]
            surface[:, :, :, [0, -1]] = surface[:, :, :, [1, -2]]

    def arguments(self) -> tuple[np.ndarray, ...]:
        """What every kernel with gels takes, in this order: nodes and corners with the margins round them."""
        return (
            self._nodes, self.surface.reshape(-1), self.contact_force.reshape(-1), self._corners,
            self.lattice.reshape(-1, LANES),
        )  # fmt: skip


def with_margins(shape: tuple[int, ...], margin: int) -> tuple[np.ndarray, np.ndarray]:
    """Zeros with `margin` more before and behind: the whole memory, and the array in its middle."""
    margin = padded(margin)
    memory = aligned_zeros(math.prod(shape) + 2 * margin)
    return memory, memory[margin:-margin].reshape(shape)


def gel_surface(params: GelParams, top: np.ndarray) -> GelSurface:
    """top: displacement of the surface's nodes (nx + 1, ny + 1, 3) [mm]."""
    half = params.half
    return GelSurface(np.ascontiguousarray(top / np.float32(MM)), params.spacing / MM, (-half[0] / MM, -half[1] / MM))

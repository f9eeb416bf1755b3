"""Elastic gel layer: total-Lagrangian trilinear hexahedra in the sensor's own frame, bonded to a rigid backing.

The lattice index k = 0 is the backing, k = nz the free surface (z = 0 of the sensor frame). The sensor may move in the
world; its gel does not notice. Inside: mm, N, MPa; density scaled so that the P-wave speed is 1.
"""

from dataclasses import dataclass

import numpy as np

from tacsim.physics.material import log1p, vec3
from tacsim.runtime import ti
from tacsim.scene import Gel, GelSurface, lame

MM = 1e3  # millimetres in a metre
MPA = 1e-6  # megapascals in a pascal
HOURGLASS = 1.0 / 6.0  # the exact integral of a shear hourglass mode of a cube
SMALLEST_STRETCH = 0.05  # J below this counts as inverted

Nodes = ti.types.ndarray(dtype=vec3, ndim=4)


@dataclass(frozen=True)
class GelFacts:
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


def gel_facts(gel: Gel, element: float) -> GelFacts:
    """Fits cubic elements of about `element` [m] into the gel. Raises ValueError if its sides do not fit one cube."""
    counts = tuple(max(2 if axis == 2 else 4, round(side / element)) for axis, side in enumerate(gel.size))
    spacing = gel.size[2] / counts[2]
    for side in gel.size[:2]:
        if abs(round(side / spacing) * spacing - side) > 0.05 * spacing:
            raise ValueError(
                f"gel size {gel.size} m does not divide into cubes of {spacing * 1e3:.4g} mm (from its thickness); "
                f"choose element_size so that length, width and thickness are whole multiples of it"
            )
    nx, ny = (round(side / spacing) for side in gel.size[:2])
    mu, lam = lame(gel.material)
    return GelFacts((nx, ny, counts[2]), spacing * MM, mu * MPA, lam * MPA)


@dataclass
class GelState:
    """Displacement, velocity and force of all nodes of all gels: (gels, nx + 1, ny + 1, nz + 1, 3)."""

    u: np.ndarray
    v: np.ndarray
    f: np.ndarray


def gel_state(facts: GelFacts, gels: int) -> GelState:
    shape = (gels, *(n + 1 for n in facts.elements), 3)
    return GelState(*(np.zeros(shape, np.float32) for _ in range(3)))


def gel_surface(facts: GelFacts, state: GelState, index: int) -> GelSurface:
    top = state.u[index, :, :, -1] / np.float32(MM)
    half = facts.half
    return GelSurface(np.ascontiguousarray(top), facts.spacing / MM, (-half[0] / MM, -half[1] / MM))


@ti.func
def gel_forces(g, u: ti.template(), f: ti.template(), h, mu, lam, health: ti.template()):
    """Adds the internal forces of gel g: one-point quadrature plus hourglass stiffness (Flanagan-Belytschko modes)."""
    nx, ny, nz = u.shape[1] - 1, u.shape[2] - 1, u.shape[3] - 1
    quarter = 0.25 / h
    area = 0.25 * h * h
    stiffness = HOURGLASS * 2.0 * mu * h / 8.0
    smallest = 1e9
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                a = u[g, i, j, k]
                b = u[g, i, j, k + 1]
                c = u[g, i, j + 1, k]
                d = u[g, i, j + 1, k + 1]
                p = u[g, i + 1, j, k]
                q = u[g, i + 1, j, k + 1]
                r = u[g, i + 1, j + 1, k]
                s = u[g, i + 1, j + 1, k + 1]
                # columns of F = I + sum u (x) grad N at the cell centre
                f0 = quarter * (p + q + r + s - a - b - c - d) + vec3(1.0, 0.0, 0.0)
                f1 = quarter * (c + d + r + s - a - b - p - q) + vec3(0.0, 1.0, 0.0)
                f2 = quarter * (b + d + q + s - a - c - p - r) + vec3(0.0, 0.0, 1.0)
                c0, c1, c2 = f1.cross(f2), f2.cross(f0), f0.cross(f1)  # columns of the cofactor matrix
                jacobian = f0.dot(c0)
                smallest = ti.min(smallest, jacobian)
                safe = ti.max(jacobian, SMALLEST_STRETCH)  # keeps the logarithm finite; `health` reports it
                # neo-Hooke: P = mu F + (lambda ln J - mu) cof(F) / J
                pressure = (lam * log1p(safe - 1.0) - mu) / safe
                px = area * (mu * f0 + pressure * c0)
                py = area * (mu * f1 + pressure * c1)
                pz = area * (mu * f2 + pressure * c2)
                # hourglass amplitudes: s_x s_y, s_y s_z, s_x s_z, s_x s_y s_z
                h1 = stiffness * (a + b - c - d - p - q + r + s)
                h2 = stiffness * (a - b - c + d + p - q - r + s)
                h3 = stiffness * (a - b + c - d - p + q - r + s)
                h4 = stiffness * (-a + b + c - d + p - q - r + s)
                f[g, i, j, k] = f[g, i, j, k] + px + py + pz - h1 - h2 - h3 + h4
                f[g, i, j, k + 1] = f[g, i, j, k + 1] + px + py - pz - h1 + h2 + h3 - h4
                f[g, i, j + 1, k] = f[g, i, j + 1, k] + px - py + pz + h1 + h2 - h3 - h4
                f[g, i, j + 1, k + 1] = f[g, i, j + 1, k + 1] + px - py - pz + h1 - h2 + h3 + h4
                f[g, i + 1, j, k] = f[g, i + 1, j, k] - px + py + pz + h1 - h2 + h3 - h4
                f[g, i + 1, j, k + 1] = f[g, i + 1, j, k + 1] - px + py - pz + h1 + h2 - h3 + h4
                f[g, i + 1, j + 1, k] = f[g, i + 1, j + 1, k] - px - py + pz - h1 + h2 + h3 + h4
                f[g, i + 1, j + 1, k + 1] = f[g, i + 1, j + 1, k + 1] - px - py - pz - h1 - h2 - h3 - h4
    health[0] = ti.min(health[0], smallest)


@ti.func
def gel_advance(g, u: ti.template(), v: ti.template(), f: ti.template(), h, density, damping, dt):
    """Symplectic Euler with lumped masses; damps the old velocity only, so force readings stay exact. Clears f.

    Returns the force of the gel on its backing.
    """
    nx, ny, nz = u.shape[1] - 1, u.shape[2] - 1, u.shape[3] - 1
    keep = 1.0 - damping * dt
    backing = vec3(0.0)
    for i in range(nx + 1):
        mass_i = density * h * h * h * (0.5 if i == 0 or i == nx else 1.0)
        for j in range(ny + 1):
            mass_ij = mass_i * (0.5 if j == 0 or j == ny else 1.0)
            backing += f[g, i, j, 0]
            f[g, i, j, 0] = vec3(0.0)
            for k in range(1, nz + 1):
                mass = mass_ij * (0.5 if k == nz else 1.0)
                new = keep * v[g, i, j, k] + (dt / mass) * f[g, i, j, k]
                v[g, i, j, k] = new
                u[g, i, j, k] = u[g, i, j, k] + dt * new
                f[g, i, j, k] = vec3(0.0)
    return backing

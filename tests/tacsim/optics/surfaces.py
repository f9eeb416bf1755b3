"""Gel surfaces of the optics tests, all without symmetry."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tacsim.models.scene import GelSurface

Displacement = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def make_surface(
    displace: Displacement, size: tuple[float, float] = (20e-3, 20e-3), spacing: float = 0.5e-3
) -> GelSurface:
    """The surface whose control values are `displace(X, Y)` -> u_x, u_y, u_z [m] at its nodes."""
    nodes = [round(length / spacing) + 1 for length in size]
    origin = tuple(-(n - 1) / 2 * spacing for n in nodes)
    x, y = (start + spacing * np.arange(n) for start, n in zip(origin, nodes, strict=True))
    grid_x, grid_y = np.meshgrid(x, y, indexing="ij")
    components = [np.broadcast_to(c, grid_x.shape) for c in displace(grid_x, grid_y)]
    return GelSurface(np.stack(components, axis=-1).astype(np.float32), spacing, (origin[0], origin[1]))


def flat() -> GelSurface:
    return make_surface(lambda x, y: (x * 0, x * 0, x * 0))


def dent(
    centre: tuple[float, float] = (3e-3, 2e-3), depth: float = 0.8e-3, slide: tuple[float, float] = (0.0, 0.0)
) -> GelSurface:
    """An oval dent, wider along x, that slides the surface along with it and spreads it."""

    def displace(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        dx, dy = x - centre[0], y - centre[1]
        shape = np.exp(-((dx / 2.4e-3) ** 2) - (dy / 1.6e-3) ** 2)
        return (slide[0] + 0.08 * dx) * shape, (slide[1] + 0.05 * dy) * shape, -depth * shape

    return make_surface(displace)

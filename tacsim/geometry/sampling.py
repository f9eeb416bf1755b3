"""Where the particles of a body lie: on a lattice, or at random as blue noise. The shape's own frame, metres."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tacsim.geometry.shapes import bounding_size, lattice_particles, no_particle_error, outward_normals, shape_distance
from tacsim.geometry.tiles import cached_tiled_distance
from tacsim.interface import FloatArray, Mask
from tacsim.models.scene import Body, Mesh, Shape

REPULSION_SHARE = 0.25  # share of the missing distance by which each of two moves


def body_points(body: Body, spacing: float) -> FloatArray:
    """Particles (n, 3) [m] of a body, all inside it, about `spacing` [m] apart; each stands for volume / n.

    Raises what :func:`tacsim.geometry.shapes.lattice_particles` raises.
    """
    lattice = lattice_particles(body.geometry, spacing)
    return lattice if body.sampling == "lattice" else blue_noise_points(body.geometry, spacing, body.seed)


def blue_noise_points(geometry: Shape, spacing: float, seed: int) -> FloatArray:
    """Blue noise: one particle at random in each cell of a lattice, then pushed apart. Same seed, same particles.

    Independent random particles leave holes and clumps, in which stress and so the print are rough. Repulsion between
    particles closer than 1.1 spacings, and from their mirror images behind the surface, evens them out (as in de Goes
    et al. 2012, Blue noise through optimal transport, but by pair forces) and leaves no direction preferred.
    """
    min_depth = 0.05  # no particle nearer to the surface than this [spacings]
    # particles nearer than this push each other apart [spacings]; evenly spread ones are ~1.1 apart
    repulsion_range = 1.1
    repulsion_steps = 20  # of mutual repulsion
    random = np.random.default_rng(seed)
    size = bounding_size(geometry)
    layers = np.maximum(np.rint(size / spacing).astype(int), 1)
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in layers), indexing="ij"), axis=-1).reshape(-1, 3)
    points = ((cells + random.random(cells.shape)) / layers - 0.5) * size
    surface = _distance_function(geometry, spacing)
    points = points[surface(points)[0] < 0]
    for _ in range(repulsion_steps):
        depth, normals = surface(points)
        depth = -depth
        points = points + _repulsion_steps(points, repulsion_range * spacing)
        points -= (REPULSION_SHARE * np.maximum(repulsion_range * spacing - 2 * depth, 0.0))[:, None] * normals
        depth, normals = surface(points)
        points -= np.maximum(depth + min_depth * spacing, 0.0)[:, None] * normals
    inside: Mask = shape_distance(geometry, points) < 0  # at sharp edges of a mesh its grid is not exact
    if not inside.any():
        raise no_particle_error(geometry, spacing)
    return np.asarray(points[inside])


def _distance_function(geometry: Shape, spacing: float) -> Callable[[FloatArray], tuple[FloatArray, FloatArray]]:
    """Function of points (n, 3) [m] for many calls: signed distance (n,) [m] and its gradient (n, 3) [-].

    Exact for the closed forms; a mesh is asked once, at the nodes of a grid of `spacing` [m].
    """
    if isinstance(geometry, Mesh):
        return cached_tiled_distance(geometry, spacing).sample_distance
    return lambda points: (shape_distance(geometry, points), outward_normals(geometry, points))


def _repulsion_steps(points: FloatArray, reach: float) -> FloatArray:
    """Step of each particle (n, 3) away from those within `reach`."""
    from scipy.spatial import KDTree

    pairs = KDTree(points).query_pairs(reach, output_type="ndarray")
    apart = points[pairs[:, 0]] - points[pairs[:, 1]]
    length = np.linalg.norm(apart, axis=1)
    push = (REPULSION_SHARE * (reach - length) / np.maximum(length, 1e-12 * reach))[:, None] * apart
    step = [
        np.bincount(pairs[:, 0], push[:, axis], len(points)) - np.bincount(pairs[:, 1], push[:, axis], len(points))
        for axis in range(3)
    ]
    return np.stack(step, axis=1)

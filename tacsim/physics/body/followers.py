"""Which nodes of the body's grid are light, and which heavier ones lead them.

A node outside the body that hardly any particle reaches has a mass next to nothing, and drifts for thousands of
substeps: what is measured then creeps. So a node with less than MAX_TIED_NODE_MASS has no motion of its own. Its
velocity is that of the linear field which fits its leaders best, heavy nodes nearby; what pushes it, and its mass,
pushes them in the same shares. A linear field is met exactly, so momentum and angular momentum stay. Extended B-splines
do the same to a basis (Hoellig et al. 2001; in MPM Yamaguchi et al. 2021). Why linear: docs/decisions/0002.

The kernels that follow: tacsim.physics.body.follow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacsim.interface import FloatArray
from tacsim.physics.body.tuning import MAX_LEADER_DISTANCE, MAX_LEADER_SPREAD, MAX_TIED_NODE_MASS, SLOPE_RIDGE
from tacsim.physics.exec.lanes import PARTS


@dataclass(frozen=True, eq=False)
class Links:
    """Pairs of nodes, twice: by the leader that is pushed, then by the follower that is moved.

    ends: (2, 2, n) the node that gets something, and the one that it gets it from, numbered (i ny + j) nz + k;
    shares: (2, n); parts: (2, PARTS + 1) where the pairs of each part begin, whose planes hold the nodes that get.
    """

    ends: np.ndarray
    shares: np.ndarray
    parts: np.ndarray


def node_masses(places: np.ndarray, origin: np.ndarray, cell: float, shape: tuple[int, int, int]) -> FloatArray:
    """Particle masses on the nodes of a grid, of particles at `places` (n, 3) on it [mm]."""
    s = (places - origin) * np.float32(1.0 / cell)
    first = np.floor(s - np.float32(0.5)).astype(np.int64)
    f = s - first
    weights = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2])  # (node, n, axis)
    _, ny, nz = shape
    at = (first[:, 0] * ny + first[:, 1]) * nz + first[:, 2]
    masses = np.zeros(shape).ravel()
    for i in range(3):
        for j in range(3):
            line = weights[i, :, 0] * weights[j, :, 1]
            for k in range(3):
                node = at + (i * ny + j) * nz + k
                masses += np.bincount(node, line * weights[k, :, 2], len(masses))
    return masses.reshape(shape)


def following(masses: FloatArray) -> tuple[np.ndarray, np.ndarray, FloatArray]:
    """Followers, their leaders, and the leaders' shares, (n,) each; masses: of all nodes, in particle masses."""
    light = (masses > 0.0) & (masses < MAX_TIED_NODE_MASS)
    while True:
        found = _fitted(light, (masses > 0.0) & ~light)
        follower, leader, share = found
        carried = masses.ravel().copy()
        np.add.at(carried, leader, share * carried[follower])
        sunk = (carried < MAX_TIED_NODE_MASS / 2).reshape(masses.shape) & (masses > 0.0) & ~light
        if not sunk.any():
            return found
        light |= sunk  # shares beyond the nearest leaders may be negative: one that they leave no mass follows, too


def _fitted(light: np.ndarray, heavy: np.ndarray) -> tuple[np.ndarray, np.ndarray, FloatArray]:
    """The value at each light node of the linear field that fits its leaders best, weighted by 1 / distance^4."""
    ball = np.arange(-MAX_LEADER_DISTANCE, MAX_LEADER_DISTANCE + 1)
    offsets = np.stack(np.meshgrid(ball, ball, ball, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = np.sqrt((offsets**2).sum(axis=1))
    inside = (distance > 0.0) & (distance <= MAX_LEADER_DISTANCE)
    offsets, distance = offsets[inside], distance[inside]
    nodes = np.argwhere(light)
    padded = np.pad(heavy, MAX_LEADER_DISTANCE)
    leads = padded[tuple((nodes[:, None] + offsets + MAX_LEADER_DISTANCE).transpose(2, 0, 1))]
    away = np.where(leads, distance, np.inf)
    nearest = away.min(axis=1, initial=np.inf)
    nodes, away, nearest = (rows[np.isfinite(nearest)] for rows in (nodes, away, nearest))
    weights = np.where(away <= nearest[:, None] + MAX_LEADER_SPREAD, away, np.inf) ** -4.0
    basis = np.column_stack([np.ones(len(offsets)), offsets])
    normal = (weights @ (basis[:, :, None] * basis[:, None, :]).reshape(-1, 16)).reshape(-1, 4, 4)
    normal[:, 1:, 1:] += SLOPE_RIDGE * weights.sum(axis=1)[:, None, None] * np.eye(3)
    # the row of the inverse that gives the value at the node itself
    value = np.linalg.solve(normal, np.broadcast_to([[1.0], [0.0], [0.0], [0.0]], (len(nodes), 4, 1)))[:, :, 0]
    shares: np.ndarray = weights * (value @ basis.T)
    row, column = np.nonzero(weights)
    follower = np.ravel_multi_index(tuple(nodes[row].T), light.shape)
    leader = np.ravel_multi_index(tuple((nodes[row] + offsets[column]).T), light.shape)
    return follower, leader, shares[row, column]


def links(masses: FloatArray) -> Links:
    """Of a grid with such particle masses on its nodes."""
    follower, leader, share = following(masses)
    planes = np.array([masses.shape[0] * part // PARTS for part in range(PARTS + 1)])
    ends, shares, parts = [], [], []
    for gets, gives in ((leader, follower), (follower, leader)):
        order = np.lexsort((gives, gets))
        ends.append([gets[order], gives[order]])
        shares.append(share[order])
        parts.append(np.searchsorted(gets[order], planes * masses.shape[1] * masses.shape[2]))
    return Links(np.array(ends, np.int32), np.array(shares, np.float32), np.array(parts, np.int32))

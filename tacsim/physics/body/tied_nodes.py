"""Finds the nodes of the body's grid with little mass, and ties each to full nodes nearby.

A node at the border of the body has a mass close to zero and drifts for thousands of substeps; measured forces then
creep. Therefore a node with less than MAX_TIED_NODE_MASS has no motion of its own. Its velocity is that of the linear
field with the best fit to its support, the full nodes nearby. Its mass and the forces on it are added to these nodes in
the same shares. The fit reproduces linear fields exactly, so momentum and angular momentum are conserved. Extended
B-splines do the same for a basis (Hoellig et al. 2001; in MPM Yamaguchi et al. 2021). Why linear: docs/decisions/0002.

The kernels: tacsim.physics.body.tied_node_kernels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacsim.interface import FloatArray
from tacsim.physics.body.tuning import MAX_SUPPORT_DISTANCE, MAX_SUPPORT_SPREAD, MAX_TIED_NODE_MASS, SLOPE_RIDGE
from tacsim.physics.exec.lanes import PARTS


@dataclass(frozen=True, eq=False)
class Links:
    """Pairs of nodes in two tables: sorted by the full node (for impulses), and by the tied node (for velocities).

    ends: (2, 2, n) receiving node and giving node, numbered (i ny + j) nz + k; shares: (2, n); parts: (2, PARTS + 1)
    where the pairs of each part begin. A part has the pairs whose receiving nodes are in its planes.
    """

    ends: np.ndarray
    shares: np.ndarray
    parts: np.ndarray


def node_masses(places: np.ndarray, origin: np.ndarray, cell: float, shape: tuple[int, int, int]) -> FloatArray:
    """Mass of each node of a grid, in particle masses, of particles at `places` (n, 3) on the grid [mm]."""
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


def tie_light_nodes(masses: FloatArray) -> tuple[np.ndarray, np.ndarray, FloatArray]:
    """Tied nodes, their full nodes, and the shares of these, (n,) each; masses: of all nodes, in particle masses."""
    light = (masses > 0.0) & (masses < MAX_TIED_NODE_MASS)
    while True:
        found = _interpolation_shares(light, (masses > 0.0) & ~light)
        tied, support, share = found
        total = masses.ravel().copy()
        np.add.at(total, support, share * total[tied])
        lightened = (total < MAX_TIED_NODE_MASS / 2).reshape(masses.shape) & (masses > 0.0) & ~light
        if not lightened.any():
            return found
        light |= lightened  # shares may be negative: a full node that they leave with little mass is tied, too


def _interpolation_shares(light: np.ndarray, full: np.ndarray) -> tuple[np.ndarray, np.ndarray, FloatArray]:
    """Tied nodes, full nodes and shares of the linear fit to the full nodes, which are weighted by 1 / distance^4."""
    ball = np.arange(-MAX_SUPPORT_DISTANCE, MAX_SUPPORT_DISTANCE + 1)
    offsets = np.stack(np.meshgrid(ball, ball, ball, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = np.sqrt((offsets**2).sum(axis=1))
    inside = (distance > 0.0) & (distance <= MAX_SUPPORT_DISTANCE)
    offsets, distance = offsets[inside], distance[inside]
    nodes = np.argwhere(light)
    padded = np.pad(full, MAX_SUPPORT_DISTANCE)
    supports = padded[tuple((nodes[:, None] + offsets + MAX_SUPPORT_DISTANCE).transpose(2, 0, 1))]
    reach = np.where(supports, distance, np.inf)
    nearest = reach.min(axis=1, initial=np.inf)
    nodes, reach, nearest = (rows[np.isfinite(nearest)] for rows in (nodes, reach, nearest))
    weights = np.where(reach <= nearest[:, None] + MAX_SUPPORT_SPREAD, reach, np.inf) ** -4.0
    basis = np.column_stack([np.ones(len(offsets)), offsets])
    normal = (weights @ (basis[:, :, None] * basis[:, None, :]).reshape(-1, 16)).reshape(-1, 4, 4)
    normal[:, 1:, 1:] += SLOPE_RIDGE * weights.sum(axis=1)[:, None, None] * np.eye(3)
    # row of the inverse for the value at the node itself
    value = np.linalg.solve(normal, np.broadcast_to([[1.0], [0.0], [0.0], [0.0]], (len(nodes), 4, 1)))[:, :, 0]
    shares: np.ndarray = weights * (value @ basis.T)
    row, column = np.nonzero(weights)
    tied = np.ravel_multi_index(tuple(nodes[row].T), light.shape)
    support = np.ravel_multi_index(tuple((nodes[row] + offsets[column]).T), light.shape)
    return tied, support, shares[row, column]


def tied_node_links(masses: FloatArray) -> Links:
    """The pairs for a grid with these node masses [particle masses]."""
    tied, support, share = tie_light_nodes(masses)
    planes = np.array([masses.shape[0] * part // PARTS for part in range(PARTS + 1)])
    ends, shares, parts = [], [], []
    for receivers, givers in ((support, tied), (tied, support)):
        order = np.lexsort((givers, receivers))
        ends.append([receivers[order], givers[order]])
        shares.append(share[order])
        parts.append(np.searchsorted(receivers[order], planes * masses.shape[1] * masses.shape[2]))
    return Links(np.array(ends, np.int32), np.array(shares, np.float32), np.array(parts, np.int32))

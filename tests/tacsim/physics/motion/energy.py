"""Total energy of a squeezed body and its gels, of a snapshot, in double precision: what tests of balances measure."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim import pose as se3
from tacsim.physics.body.plasticine import bounds_of_points, grid_around
from tacsim.physics.body.tied_nodes import node_masses, tie_light_nodes
from tacsim.physics.body.tuning import STENCIL_REACH
from tacsim.physics.contact.contact import ANCHOR_ON_GEL
from tacsim.physics.contact.tuning import PARTICLE_TANGENTIAL_STIFFNESS
from tacsim.physics.exec import layout
from tacsim.physics.gel.tuning import HOURGLASS_STIFFNESS
from tacsim.physics.worlds.hybrid import HybridWorld

Array = NDArray[Any]


def of_gel(u: Array, v: Array, h: float, mu: float, lam: float, density: float) -> float:
    """Elastic and kinetic [N mm]; u, v: (nx + 1, ny + 1, nz + 1, 3) displacements [mm] and velocities of the nodes."""
    nx, ny, nz = (n - 1 for n in u.shape[:3])
    corners = {(i, j, k): u[i : nx + i, j : ny + j, k : nz + k] for i, j, k in product((0, 1), repeat=3)}
    signs = {key: np.array(key) * 2 - 1 for key in corners}
    f = np.stack([sum(signs[key][d] * at for key, at in corners.items()) for d in range(3)], axis=-1) / (4 * h)
    f = f + np.eye(3)
    log_volume = np.log(np.linalg.det(f))
    energy = h**3 * float((mu / 2 * ((f**2).sum((-1, -2)) - 3 - 2 * log_volume) + lam / 2 * log_volume**2).sum())
    for axes in ((0, 1), (1, 2), (0, 2), (0, 1, 2)):  # hourglass modes
        mode = sum(np.prod(signs[key][list(axes)]) * at for key, at in corners.items())
        energy += HOURGLASS_STIFFNESS * 2 * mu * h / 16 * float((np.asarray(mode) ** 2).sum())
    mass = np.full(u.shape[:3], density * h**3)
    mass[[0, -1]] /= 2
    mass[:, [0, -1]] /= 2
    mass[:, :, -1] /= 2
    mass[:, :, 0] = 0
    return energy + float((mass * (v**2).sum(-1)).sum()) / 2


def of_body(state: Mapping[str, Array], params: Array) -> float:
    """Elastic energy of the particles (Hencky) and kinetic energy of the grid's nodes [N mm]."""
    e = state["strain"].astype(float)
    rows = e[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(-1, 3, 3)  # xx, yy, zz, xy, xz, yz
    strain = np.log1p(np.linalg.eigvalsh(rows)) / 2
    trace = strain.sum(axis=1)
    deviator = strain - trace[:, None] / 3
    mu, bulk = params[layout.BODY_MU], params[layout.BODY_BULK]
    elastic = params[layout.BODY_VOLUME] * (mu * (deviator**2).sum() + bulk / 2 * (trace**2).sum())
    cell, v = params[layout.BODY_CELL], state["grid_velocity"].astype(float)
    if v.size == 0:
        return float(elastic)
    origin, shape = grid_around(*bounds_of_points(state["reference"]), cell, STENCIL_REACH * cell)
    mass = node_masses(state["reference"], origin, cell, shape)
    follower, leader, share = tie_light_nodes(mass)
    whole = mass.ravel().copy()
    np.add.at(whole, leader, share * mass.ravel()[follower])
    whole[follower] = 0
    moving = whole.reshape(shape)[:, :, : v.shape[2]] * (v**2).sum(-1)
    return float(elastic) + float(params[layout.BODY_MASS]) * float(moving.sum()) / 2


def splines(a: Array) -> tuple[Array, Array, Array]:
    """First node of the stencil round lattice coordinates a (n,), weights (3, n) and their derivatives."""
    first = np.floor(a + 0.5).astype(int) - 1
    t = a - first
    weights = np.stack([(1.5 - t) ** 2 / 2, 0.75 - (t - 1) ** 2, (t - 0.5) ** 2 / 2])
    return first, weights, np.stack([t - 1.5, 2 - 2 * t, t - 0.5])


def of_contact(world: HybridWorld, state: Mapping[str, Array], params: Array, g: int) -> float:
    """Of the springs between particles and gel g [N mm], normal and tangential."""
    pose, h = world.pose(world.sensors[g]), params[layout.GEL_SPACING]
    history = state["contact"][g].astype(float)
    on = history[:, 2] == ANCHOR_ON_GEL
    history = history[on]
    x = ((state["position"].astype(float) - 1e3 * pose.position) @ se3.rotation_matrix(pose))[on]
    u = state["gel_displacement"][g][:, :, -1].astype(float)
    n = np.array(u.shape[:2]) - 1
    start = x[:, :2] / h + n / 2
    a = start - history[:, 4:6] / h
    for _ in range(5):  # to the point of the surface under the particle
        (i, wx, dx), (j, wy, dy) = splines(a[:, 0]), splines(a[:, 1])
        at, t1, t2 = np.zeros_like(x), np.zeros_like(x) + [1, 0, 0], np.zeros_like(x) + [0, 1, 0]
        for p, q in product(range(3), repeat=2):
            node = u[np.clip(i + p, 0, n[0]), np.clip(j + q, 0, n[1])]
            at += (wx[p] * wy[q])[:, None] * node
            t1 += (dx[p] * wy[q])[:, None] * node / h
            t2 += (wx[p] * dy[q])[:, None] * node / h
        miss = start - a - at[:, :2] / h
        a += np.linalg.solve(np.stack([t1[:, :2], t2[:, :2]], axis=-1), miss[:, :, None])[:, :, 0]
    normal = np.cross(t1, t2)
    overlap = (at[:, 2] + history[:, 6] - x[:, 2]) * normal[:, 2] / np.linalg.norm(normal, axis=1)
    slip = x[:, :2] - h * (start - a) - history[:, :2]
    stuck = slip[:, :1] * t1 + slip[:, 1:] * t2
    springs = (np.maximum(overlap + history[:, 3], 0) ** 2).sum() + PARTICLE_TANGENTIAL_STIFFNESS * (stuck**2).sum()
    return float(params[layout.STIFFNESS]) * float(springs) / 2


def total_energy(world: HybridWorld) -> float:
    """Kinetic, elastic and of contact [N mm], after a motion in real time."""
    state, params = world.snapshot(), world.state.params[0].astype(float)
    material = [params[i] for i in (layout.GEL_SPACING, layout.GEL_MU, layout.GEL_LAMBDA, layout.GEL_DENSITY)]
    gels = zip(state["gel_displacement"].astype(float), state["gel_velocity"].astype(float), strict=True)
    contacts = (of_contact(world, state, params, g) for g in range(2))
    return sum(of_gel(u, v, *material) for u, v in gels) + of_body(state, params) + sum(contacts)

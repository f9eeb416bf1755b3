"""One step of MuJoCo in which the forces of gel pads follow the motion of the step: linearly implicit in joint space.

A pad's mean wrench in the step is w + K dt v', with v' = J qvel after the step, the object's velocity relative to the
pad, and w the wrench without motion. With the inertia M this is (M + dt^2 J^T K J) a = ..., so that a stiff gel and a
light object need no short step. At rest v' = 0, and the wrench is that of the gel, whatever K is. Along the
surface the wrench grows up to the limit of friction only: without K a light object would be thrown to and fro by
friction, without the limit K would drag like a viscous fluid.

MuJoCo solves for its own constraints (contacts, limits, equalities). Its solution and the wrench are iterated by Newton
until they agree, with the Hessian of its active constraints added to M.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from tacsim.interface import FloatArray
from tacsim.sim.engines.mujoco_module import load_mujoco

MAX_SOLUTIONS = 8  # of MuJoCo's constraints in one step
TOLERANCE = 1e-6  # of the generalised force, relative to the largest


class Response(Protocol):
    """How the wrench of a pad follows a motion of its object: `tacsim.physics.worlds.patch.PatchResponse`."""

    def after(self, motion: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The wrench (6,) after a motion (6,), and its change by a further one (6, 6)."""
        ...


def inertia(model: Any, data: Any) -> FloatArray:
    """The mass matrix (nv, nv)."""
    matrix = np.zeros((model.nv, model.nv))
    load_mujoco().mj_fullM(model, data, matrix)
    return matrix


def constraint_hessian(model: Any, data: Any) -> FloatArray:
    """Second derivative (nv, nv) of the cost of MuJoCo's active constraints by the acceleration."""
    mujoco = load_mujoco()
    rows = int(data.nefc)
    if rows == 0:
        return np.zeros((model.nv, model.nv))
    jacobian = np.zeros((rows, model.nv))
    if mujoco.mj_isSparse(model):
        mujoco.mju_sparse2dense(jacobian, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
    else:
        jacobian[:] = data.efc_J.reshape(rows, model.nv)
    states = mujoco.mjtConstraintState
    quadratic, cone = int(states.mjCNSTRSTATE_QUADRATIC), int(states.mjCNSTRSTATE_CONE)
    active = (data.efc_state == quadratic) | (data.efc_state == cone)
    return np.asarray(jacobian.T @ ((data.efc_D * active)[:, None] * jacobian))


def velocity_gain(model: Any, data: Any, mass: FloatArray) -> FloatArray:
    """Change of the velocity over dt, for one of MuJoCo's acceleration (nv, nv): the integrators treat damping of
    joints and of servos implicitly."""
    mujoco = load_mujoco()
    damping = np.zeros((model.nv, model.nv))
    np.fill_diagonal(damping, model.dof_damping)
    if model.nu and int(model.opt.integrator) != int(mujoco.mjtIntegrator.mjINT_EULER):
        servos = np.where(
            model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE), -model.actuator_biasprm[:, 2], 0
        )
        if servos.any():
            moment = np.zeros((model.nu, model.nv))
            rows = data.moment_rownnz, data.moment_rowadr, data.moment_colind
            mujoco.mju_sparse2dense(moment, data.actuator_moment, *rows)
            damping = damping + moment.T @ (servos[:, None] * moment)
    if not damping.any():
        return np.eye(model.nv)
    return np.asarray(np.linalg.solve(mass + model.opt.timestep * damping, mass))


def step_with_wrenches(model: Any, data: Any, jacobian: FloatArray, responses: Sequence[Response]) -> int:
    """Ends a step that `mj_step1` has begun. jacobian: (6 k, nv) of the motions of objects relative to pads; responses:
    of these k pads. Returns how often constraints were solved.

    `data.qfrc_applied` of the user counts, and is as before afterwards.
    """
    mujoco = load_mujoco()
    dt, user = float(model.opt.timestep), data.qfrc_applied.copy()
    mass = inertia(model, data)
    moving = dt * (jacobian @ data.qvel)
    to_motion = dt * dt * (jacobian @ velocity_gain(model, data, mass))  # motion in the step by an acceleration
    wrench, tangent = _predict(responses, np.zeros(len(jacobian)))
    applied, change, least, solutions = -jacobian.T @ wrench, np.zeros(model.nv), math.inf, 0
    mujoco.mj_fwdActuation(model, data)
    while True:
        data.qfrc_applied[:] = user + applied
        mujoco.mj_fwdAcceleration(model, data)
        mujoco.mj_fwdConstraint(model, data)
        solutions += 1
        motion = moving + to_motion @ data.qacc
        if solutions == 1:  # by springs alone: from the side of sliding, Newton would jump to and fro
            error = -jacobian.T @ (tangent @ motion)
        else:
            wrench, tangent = _predict(responses, motion)
            error = -jacobian.T @ wrench - applied
        size = float(np.abs(error).max())
        if solutions == MAX_SOLUTIONS or size <= TOLERANCE * np.abs(applied).max():
            break
        data.qacc_warmstart[:] = data.qacc
        if solutions > 2 and size > least:  # too far
            change = change / 2
            applied = applied - change
            continue
        if solutions > 1:
            least = size
        slope = jacobian.T @ tangent @ to_motion
        hessian = mass + constraint_hessian(model, data) if data.nefc else mass
        change = error - slope @ np.linalg.solve(hessian + slope, error)
        applied = applied + change
    mujoco.mj_step2(model, data)
    data.qfrc_applied[:] = user
    return solutions


def _predict(responses: Sequence[Response], motion: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Wrenches (6 k,) after a motion (6 k,), and their change by a further one (6 k, 6 k)."""
    count = len(responses)
    wrenches, tangents = np.empty(6 * count), np.zeros((6 * count, 6 * count))
    for at, response in enumerate(responses):
        own = slice(6 * at, 6 * at + 6)
        wrenches[own], tangents[own, own] = response.after(motion[own])
    return wrenches, tangents

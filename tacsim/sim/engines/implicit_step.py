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
from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import FloatArray
from tacsim.sim.engines.mujoco_module import load_mujoco

MAX_SOLUTIONS = 8  # of MuJoCo's constraints in one step
TOLERANCE = 1e-6  # of the generalised force, relative to the largest


class Responses(Protocol):
    """How the wrenches of k pads follow motions of their objects: `tacsim.physics.pads.patch.PatchResponses`."""

    def after(self, motions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The wrenches (k, 6) after motions (k, 6), and their changes by further ones (k, 6, 6)."""
        ...


def inertia(model: Any, data: Any) -> FloatArray:
    """The mass matrix (nv, nv)."""
    matrix = np.empty((model.nv, model.nv))
    load_mujoco().mj_fullM(model, data, matrix)
    return matrix


def constraint_hessian(model: Any, data: Any) -> FloatArray:
    """Second derivative (nv, nv) of the cost of MuJoCo's active constraints by the acceleration."""
    mujoco, rows = load_mujoco(), int(data.nefc)
    if rows == 0:
        return np.zeros((model.nv, model.nv))
    if mujoco.mj_isSparse(model):
        jacobian = np.zeros((rows, model.nv))
        mujoco.mju_sparse2dense(jacobian, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
    else:
        jacobian = data.efc_J.reshape(rows, model.nv)
    return np.asarray((jacobian.T * (data.efc_D * _is_active(data))) @ jacobian)


def _is_active(data: Any) -> NDArray[np.bool_]:
    """(rows,) constraints whose force changes with the acceleration. By their forces: where MuJoCo solves by islands,
    `efc_state` is that of its first guess."""
    equality, dry_friction = _constraint_types()
    types, forces = data.efc_type, data.efc_force
    slides = np.isin(types, dry_friction) & (np.abs(forces) >= data.efc_frictionloss)
    return np.asarray((types == equality) | ((forces != 0.0) & ~slides))


@cache
def _constraint_types() -> tuple[int, list[int]]:
    """Of MuJoCo's equalities, and of dry friction in joints and tendons."""
    types = load_mujoco().mjtConstraint
    return int(types.mjCNSTR_EQUALITY), [int(types.mjCNSTR_FRICTION_DOF), int(types.mjCNSTR_FRICTION_TENDON)]


def damping_of(model: Any, data: Any) -> FloatArray | None:
    """(nv, nv) change of the generalised force, without its sign, by the velocity: of what MuJoCo's integrators treat
    implicitly, damping of joints and of servos. None: there is none."""
    mujoco, joints = load_mujoco(), model.dof_damping
    damping = np.diag(joints) if joints.any() else None
    if model.nu and int(model.opt.integrator) != int(mujoco.mjtIntegrator.mjINT_EULER):
        servos = np.where(
            model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE), -model.actuator_biasprm[:, 2], 0
        )
        if servos.any():
            moment = np.zeros((model.nu, model.nv))
            rows = data.moment_rownnz, data.moment_rowadr, data.moment_colind
            mujoco.mju_sparse2dense(moment, data.actuator_moment, *rows)
            own = (moment.T * servos) @ moment
            damping = own if damping is None else damping + own
    return damping


def _motion_gain(model: Any, data: Any, mass: FloatArray, jacobian: FloatArray) -> FloatArray:
    """(6 k, nv) motions in a step by one of MuJoCo's accelerations. MuJoCo adds (M + dt D)^-1 M dt of it to the
    velocity, with the damping D."""
    dt, damping = float(model.opt.timestep), damping_of(model, data)
    if damping is None:
        return dt * dt * jacobian
    return np.asarray(dt * dt * (jacobian @ np.linalg.solve(mass + dt * damping, mass)))


def step_with_wrenches(model: Any, data: Any, jacobian: FloatArray, responses: Responses) -> int:
    """Ends a step that `mj_step1` has begun. jacobian: (6 k, nv) of the motions of objects relative to pads; responses:
    of these k pads. Returns how often constraints were solved.

    `data.qfrc_applied` of the user counts, and is as before afterwards.
    """
    mujoco, push = load_mujoco(), data.qfrc_applied
    user, backward = push.copy(), -jacobian.T
    mass = inertia(model, data)
    moving = float(model.opt.timestep) * (jacobian @ data.qvel)
    to_motion = _motion_gain(model, data, mass, jacobian)
    wrenches, tangents = responses.after(np.zeros((len(jacobian) // 6, 6)))
    applied, change, least, solutions = backward @ wrenches.ravel(), np.zeros(model.nv), math.inf, 0
    mujoco.mj_fwdActuation(model, data)
    while True:
        push[:] = user + applied
        mujoco.mj_fwdAcceleration(model, data)
        mujoco.mj_fwdConstraint(model, data)
        solutions += 1
        motions = (moving + to_motion @ data.qacc).reshape(-1, 6)
        if solutions == 1:  # by springs alone: from the side of sliding, Newton would jump to and fro
            error = backward @ (tangents @ motions[..., None]).ravel()
        else:
            wrenches, tangents = responses.after(motions)
            error = backward @ wrenches.ravel() - applied
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
        slope = backward @ (tangents @ to_motion.reshape(-1, 6, model.nv)).reshape(-1, model.nv)
        hessian = mass + constraint_hessian(model, data) if data.nefc else mass
        change = error + slope @ np.linalg.solve(hessian - slope, error)
        applied = applied + change
    mujoco.mj_step2(model, data)
    push[:] = user
    return solutions

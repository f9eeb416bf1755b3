"""What moves in a cell: a free flange, the joints of an arm, the fingers of a gripper; each for one control period."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim import pose as se3
from tacsim.interface import FloatArray, Pose
from tacsim.limits import LimitExceeded
from tacsim.sim.cell import tuning
from tacsim.sim.cell.description import ArmDescription, GripperDescription
from tacsim.sim.cell.ramp import Ramp
from tacsim.sim.engines.implicit_step import inertia
from tacsim.sim.engines.mujoco_module import load_mujoco
from tacsim.sim.engines.quaternion import product, rotated, rotation_vector, turned_by

State = Mapping[str, NDArray[Any]]


def site_pose(data: Any, site: int) -> Pose:
    """world_from_site, as MuJoCo has computed its frames last."""
    return _pose_of(data.site_xpos[site].tobytes(), data.site_xmat[site].tobytes())


@lru_cache(maxsize=256)  # each pose is asked several times a step
def _pose_of(position: bytes, axes: bytes) -> Pose:
    return se3.from_axes(np.frombuffer(position), np.frombuffer(axes).reshape(3, 3))


class FreeDrive:
    """A free flange that reaches every commanded pose exactly: its velocity is set, and it is too heavy to be
    disturbed."""

    joints = None

    def __init__(self, model: Any, data: Any, name: str, tool: int) -> None:
        self._model, self._data, self._tool = model, data, tool
        joint = model.joint(f"{name}/flange")
        self._places, self._speeds = int(joint.qposadr[0]), int(joint.dofadr[0])
        self._flange_from_tool = Pose(model.site_pos[tool], np.roll(model.site_quat[tool], -1))
        self._tool_from_flange = se3.inverse(self._flange_from_tool)
        self._target = self._start = Pose()
        self._ramp = Ramp.rest(6)  # shift and rotation vector
        self._last_speed = np.zeros(6)

    def place(self, tool: Pose) -> None:
        """Puts it there at once, at rest."""
        flange = se3.compose(tool, self._tool_from_flange)
        self._data.qpos[self._places : self._places + 7] = [*flange.position, *np.roll(flange.quaternion, 1)]
        self._data.qvel[self._speeds : self._speeds + 6] = 0.0
        self._target, self._last_speed = tool, np.zeros(6)

    def begin(self, target: Pose | None, seconds: float) -> None:
        """Plans the next `seconds`: to a pose of the tool; None: to its last target."""
        self._target = self._target if target is None else target
        self._start = site_pose(self._data, self._tool)
        displacement = se3.pose_difference(self._start, self._target)
        self._ramp = Ramp.plan(displacement, self._last_speed, seconds)

    def apply(self, time: float) -> None:
        """Before a step that begins `time` [s] after `begin`: what makes it follow its plan."""
        dt = float(self._model.opt.timestep)
        after = time + dt
        self._last_speed, displacement = self._ramp.speed(after), self._ramp.displacement(after)
        # quaternions as plain numbers: this is called in each timestep
        tool = turned_by(self._start.quaternion.tolist(), displacement[3:].tolist())
        arm = rotated(self._tool_from_flange.position.tolist(), tool)
        to = product(tool, self._tool_from_flange.quaternion.tolist())
        place = self._data.qpos[self._places : self._places + 7]
        w, x, y, z = place[3:].tolist()
        speed = self._data.qvel[self._speeds : self._speeds + 6]
        speed[:3] = (self._start.position + displacement[:3] + arm - place[:3]) / dt
        # MuJoCo has a free body's spin in its own axes
        speed[3:] = np.array(rotation_vector(product((-x, -y, -z, w), to))) / dt

    def snapshot(self) -> dict[str, NDArray[Any]]:
        return {"target": np.concatenate([self._target.position, self._target.quaternion]), "speed": self._last_speed}

    def restore(self, state: State) -> None:
        self._target = Pose(state["target"][:3], state["target"][3:])
        self._last_speed = np.array(state["speed"])


class JointDrive:
    """The joints of an arm: each is controlled to follow its path, with the inertia of the arm known (computed torque),
    and up to its greatest torque."""

    def __init__(self, model: Any, data: Any, joints: tuple[str, ...], tool: int, description: ArmDescription) -> None:
        mujoco = load_mujoco()
        self._model, self._data, self._tool = model, data, tool
        found = [model.joint(name) for name in joints]
        self._places = np.array([int(joint.qposadr[0]) for joint in found])
        self._speeds = np.array([int(joint.dofadr[0]) for joint in found])
        self._ranges = np.array([joint.range if joint.limited[0] else (-2 * np.pi, 2 * np.pi) for joint in found])
        torques = [link.max_torque for link in description.links]
        self._max_torque = np.array(torques) if torques else np.full(len(found), np.inf)
        speeds = [link.max_speed for link in description.links]
        self._max_speed = np.array(speeds) if speeds else np.full(len(found), np.inf)
        self._scratch = mujoco.MjData(model)
        self._reference = self._start = np.zeros(len(found))
        self._speed = np.zeros(len(found))
        self._ramp = Ramp.rest(len(found))
        self.limited = 0  # steps in which a joint had its greatest torque

    @property
    def joints(self) -> FloatArray:
        return np.array(self._data.qpos[self._places])

    def place(self, joints: FloatArray) -> None:
        """Puts the joints there at once, at rest."""
        self._data.qpos[self._places], self._data.qvel[self._speeds] = joints, 0.0
        self._reference, self._speed = np.array(joints), np.zeros(len(joints))

    def find_joints(self, tool: Pose, seed: FloatArray) -> FloatArray:
        """Joints that bring the tool to a pose, from `seed` (n,) by damped least squares. Raises LimitExceeded."""
        mujoco, scratch = load_mujoco(), self._scratch
        scratch.qpos[:] = self._data.qpos
        joints, jacobian = np.array(seed), np.zeros((6, self._model.nv))
        for _ in range(tuning.MAX_JOINT_STEPS):
            scratch.qpos[self._places] = joints
            mujoco.mj_kinematics(self._model, scratch)
            mujoco.mj_comPos(self._model, scratch)
            error = se3.pose_difference(site_pose(scratch, self._tool), tool)
            size = float(np.linalg.norm(error))
            if size < tuning.JOINT_TOLERANCE:
                break
            mujoco.mj_jacSite(self._model, scratch, jacobian[:3], jacobian[3:], self._tool)
            columns = jacobian[:, self._speeds]
            damping = 1e-4 * min(size, 1.0) * np.eye(6)
            joints = joints + (columns.T @ np.linalg.solve(columns @ columns.T + damping, error)).clip(-0.3, 0.3)
        inside = (joints >= self._ranges[:, 0]).all() and (joints <= self._ranges[:, 1]).all()
        if size >= tuning.JOINT_TOLERANCE or not inside:
            why = "is out of reach" if size >= tuning.JOINT_TOLERANCE else "needs a joint beyond its range"
            at = ", ".join(f"{each:.4g}" for each in tool.position)
            raise LimitExceeded(f"the pose of the tool at ({at}) m {why}; choose one nearer to the arm's base")
        return joints

    def begin(self, target: Pose | None, seconds: float) -> None:
        """As of a free flange. Raises LimitExceeded for a pose that no joints give, or not as fast."""
        goal = self._reference if target is None else self.find_joints(target, self._reference)
        speed = np.abs(goal - self._reference) / seconds
        if (speed > self._max_speed).any():
            joint = int(np.argmax(speed / self._max_speed))
            raise LimitExceeded(
                f"joint {joint + 1} would turn with {speed[joint]:.3g} rad/s, its greatest speed is "
                f"{self._max_speed[joint]:.3g} rad/s: go slower, or pass farther from where the arm is stretched or "
                "folded"
            )
        self._ramp = Ramp.plan(goal - self._reference, self._speed, seconds)
        self._start = self._reference

    def apply(self, time: float) -> None:
        """As of a free flange."""
        after = time + float(self._model.opt.timestep)
        self._reference, self._speed = self._start + self._ramp.displacement(after), self._ramp.speed(after)
        data, frequency = self._data, tuning.ARM_FREQUENCY
        wanted = frequency**2 * (self._reference - data.qpos[self._places])
        wanted += 2 * frequency * (self._speed - data.qvel[self._speeds])
        own = inertia(self._model, data)[np.ix_(self._speeds, self._speeds)]
        torque = own @ wanted
        allowed = torque.clip(-self._max_torque, self._max_torque)
        self.limited += int((allowed != torque).any())
        data.qfrc_applied[self._speeds] = allowed

    def snapshot(self) -> dict[str, NDArray[Any]]:
        return {"reference": self._reference, "speed": self._speed, "limited": np.array([self.limited])}

    def restore(self, state: State) -> None:
        self._reference, self._speed = np.array(state["reference"]), np.array(state["speed"])
        self.limited = int(state["limited"][0])


class GripperDrive:
    """Two fingers that close or open at most at their speed, and press with at most a force. The joints grow as the
    gripper opens; the force is positive when it closes."""

    def __init__(
        self, model: Any, data: Any, joints: tuple[str, str], pads: tuple[int, int], description: GripperDescription
    ) -> None:
        self._model, self._data, self._pads = model, data, pads
        found = [model.joint(name) for name in joints]
        self._places = np.array([int(joint.qposadr[0]) for joint in found])
        self._speeds = np.array([int(joint.dofadr[0]) for joint in found])
        self.max_speed, self._mass, self.max_width = description.speed, description.finger_mass, description.stroke
        self.target = (description.stroke, description.max_force)  # width [m], greatest force [N]
        self._reference = description.stroke / 2  # of each joint [m]
        self.force = 0.0  # of each finger, as it was in the last step [N]

    @property
    def width(self) -> float:
        """Between the pads' undeformed surfaces [m]."""
        left, right = (site_pose(self._data, pad) for pad in self._pads)
        return float((right.position - left.position) @ se3.rotation_matrix(left)[:, 2])

    def place(self, width: float) -> None:
        """Opens or closes it at once, at rest, and that is its target."""
        self.set_width(width)
        self.target = width, self.target[1]

    def set_width(self, width: float) -> None:
        """Opens or closes it at once, at rest; its target stays."""
        self._data.qpos[self._places], self._data.qvel[self._speeds] = width / 2, 0.0
        self._reference = width / 2

    def command(self, width: float, max_force: float) -> None:
        """Goes to a width [m], and presses with at most a force [N]. Where it turns round, nothing stays of the force
        before."""
        here = float(self._data.qpos[self._places].mean())
        if (width / 2 - here) * (self._reference - here) < 0:
            self._reference = here
        self.target = (width, max_force)

    def apply(self) -> None:
        """Before each step."""
        width, max_force = self.target
        goal, dt, frequency = width / 2, float(self._model.opt.timestep), tuning.FINGER_FREQUENCY
        left, right = self._places.tolist()
        here, stiffness = 0.5 * float(self._data.qpos[left] + self._data.qpos[right]), self._mass * frequency**2
        # A grip that loosens at once would be thrown open by the gels.
        max_force = max(max_force, abs(self.force) - tuning.MAX_LOOSENING * dt)
        reach = max_force / stiffness  # beyond, the force has its greatest value already
        before = min(max(self._reference, here - reach), here + reach)
        step = min(max(goal - before, -self.max_speed * dt), self.max_speed * dt)
        self._reference = before + step
        damping = 2 * self._mass * frequency
        left, right = self._speeds.tolist()
        speed = 0.5 * float(self._data.qvel[left] + self._data.qvel[right])
        pushed = stiffness * (self._reference - here) + damping * (step / dt - speed)
        self.force = -min(max(pushed, -max_force), max_force)
        self._data.qfrc_applied[left] = self._data.qfrc_applied[right] = -self.force

    def snapshot(self) -> dict[str, NDArray[Any]]:
        return {"gripper": np.array([*self.target, self._reference, self.force])}

    def restore(self, state: State) -> None:
        width, most, self._reference, self.force = (float(each) for each in state["gripper"])
        self.target = width, most

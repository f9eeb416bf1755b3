"""The world of a cell: MuJoCo moves arms, fingers and object, and the gels between them push."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim import pose as se3
from tacsim.control import ObjectDropped
from tacsim.geometry.shapes import centred_mesh, edge_points, rotated_bounding_size
from tacsim.interface import Float32, FloatArray, Pose, Truth
from tacsim.limits import LimitExceeded
from tacsim.models.scene import SIDES, GelSurface, Mesh, Scene, Sphere
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.sim.cell import tuning
from tacsim.sim.cell.description import ArmDescription, GripperDescription, ViewDescription
from tacsim.sim.cell.drives import FreeDrive, GripperDrive, JointDrive, State, site_pose
from tacsim.sim.cell.model import OBJECT, PEDESTAL, make_spec, object_start
from tacsim.sim.engines.mujoco_module import load_mujoco
from tacsim.sim.engines.mujoco_objects import find_site
from tacsim.sim.engines.touch import TouchSensor, step_each
from tacsim.sim.pads import PadPlace, SharedPads

PeriodError = LimitExceeded | SimulationDiverged | ObjectDropped  # that ends a control period
PERIOD_ERRORS = (LimitExceeded, SimulationDiverged, ObjectDropped)


class Cell:
    """One MuJoCo scene with arms, grippers with two gels each, and a rigid object. SI units, world frame.

    Frames have names: that of an arm is its tool, between the pads of its gripper (description.py), `gripper/left` and
    `gripper/right` are the pads. At construction the grippers are open around the object, where they will grip it,
    unless `starts` says where else; nothing touches but the object what it stands on.

    Raises ImportError without MuJoCo, and ValueError for what cannot be simulated: see `TouchSensor`.
    """

    def __init__(
        self,
        scene: Scene,
        arms: Mapping[str, ArmDescription],
        grippers: Mapping[str, GripperDescription],
        views: Mapping[str, ViewDescription] | None = None,
        starts: Mapping[str, Pose] | None = None,
        pads: PadPlace | None = None,
    ) -> None:
        """starts: world_from_tool of arms where an episode begins, by name; others are where they grip the object.
        pads: their place among those of other cells; None: it has its own."""
        self._pad_place = PadPlace(SharedPads(1), 0) if pads is None else pads
        mujoco = load_mujoco()
        assert scene.object is not None
        self.scene, self.item = scene, scene.object
        self.model = make_spec(scene, arms, grippers, views or {}).compile()
        self.data = mujoco.MjData(self.model)
        self._sites: dict[str, int] = {}
        self._pads: dict[str, str] = {}  # names of the sites, by frame
        self._arm_of_pad: dict[str, str] = {}
        self.grippers: dict[str, GripperDrive] = {}
        for name, gripper in grippers.items():
            self._add_gripper(name, gripper)
        self.arms: dict[str, FreeDrive | JointDrive] = {}
        for name, arm in arms.items():
            self._add_arm(name, arm, (starts or {}).get(name, grip_pose(scene)))
        self.refresh()
        self._add_gels()
        self._body = int(self.model.body(OBJECT).id)
        gravity = np.array(scene.gravity)
        self._down = gravity / (float(np.linalg.norm(gravity)) or 1.0)
        self._touched_at = self._depth_of_fall()  # along gravity, where a pad touched the object last, or it began [m]
        self._max_forces = np.zeros(len(self._pads))  # normal to each pad, since `begin` [N]
        self._points = surface_points(self.item.geometry)
        mujoco.mj_forward(self.model, self.data)

    def _add_gels(self) -> None:
        self.touch = TouchSensor.in_place(
            self._pad_place, self.model, self.data, list(self._pads.values()), OBJECT, gel=self.scene.gel,
            friction=self.item.friction, geometry={OBJECT: self.item.geometry}, preset=self.scene.preset,
        )  # fmt: skip

    def _add_gripper(self, name: str, gripper: GripperDescription) -> None:
        frames = tuple(f"{name}/{side}" for side in SIDES)
        own = f"{gripper.arm}/"  # before the names of a model of the user
        pads = tuple(own + pad for pad in gripper.pads or ()) or tuple(f"{frame}_pad" for frame in frames)
        tool = f"{name}/tool" if gripper.tool is None else own + gripper.tool
        self._sites[gripper.arm] = find_site(self.model, tool)
        for frame, pad in zip(frames, pads, strict=True):
            self._sites[frame], self._pads[frame] = find_site(self.model, pad), pad
            self._arm_of_pad[frame] = gripper.arm
        joints = (frames[0], frames[1])
        if gripper.joints is not None:
            joints = (own + gripper.joints[0], own + gripper.joints[1])
        sites = (self._sites[frames[0]], self._sites[frames[1]])
        drive = GripperDrive(self.model, self.data, joints, sites, gripper)
        drive.place(gripper.stroke)
        self.grippers[name] = drive

    def _add_arm(self, name: str, arm: ArmDescription, start: Pose) -> None:
        tool = self._sites[name]
        if not arm.links and arm.file is None:
            free = FreeDrive(self.model, self.data, name, tool)
            free.place(start)
            self.arms[name] = free
            return
        numbered = [f"joint{number + 1}" for number in range(len(arm.links))]
        joints = tuple(f"{name}/{joint}" for joint in arm.joints or numbered)
        chain = JointDrive(self.model, self.data, joints, tool, arm)
        chain.place(chain.find_joints(start, chain.joints if arm.begin is None else arm.begin))
        self.arms[name] = chain

    def refresh(self) -> None:
        """Computes all frames of the present state."""
        mujoco = load_mujoco()
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    # ------------------------------------------------------------------- time

    @property
    def timestep(self) -> float:
        return float(self.model.opt.timestep)

    def steps_of(self, seconds: float) -> int:
        """Timesteps in a time. Raises ValueError where they are no whole number."""
        number = seconds / self.timestep
        if round(number) < 1 or abs(number - round(number)) > 1e-6 * number:
            raise ValueError(
                f"a control period of {seconds:g} s is no whole number of timesteps of {self.timestep:g} s: choose "
                "another period, or scene.timestep"
            )
        return round(number)

    def begin(self, targets: Mapping[str, Pose], seconds: float) -> None:
        """Plans the motion of all arms for `seconds`, see `ArmDrive.begin`; begins a new count for `diagnostics`."""
        self._max_forces[:] = 0.0
        for name, arm in self.arms.items():
            arm.begin(targets.get(name), seconds)

    def drive(self, time: float) -> None:
        """Before a timestep that begins `time` [s] after `begin`: arms and fingers follow their plans."""
        for arm in self.arms.values():
            arm.apply(time)
        for gripper in self.grippers.values():
            gripper.apply()

    def watch(self) -> None:
        """After a timestep: counts for `diagnostics`. Raises ObjectDropped."""
        wrenches = self.touch.wrenches
        if wrenches.any():
            self._max_forces = np.maximum(self._max_forces, -wrenches[:, 2])
            self._touched_at = self._depth_of_fall()
        elif self._depth_of_fall() - self._touched_at > tuning.FALL_HEIGHT and self.item.guide is None:
            self.touch.require_held()
            raise ObjectDropped(
                f"the object falls: at {self.data.time:.4g} s no pad has touched it yet, and it is at z = "
                f"{float(self.data.xpos[self._body, 2]):.4g} m; was its pedestal taken away before it was gripped?"
            )

    def _depth_of_fall(self) -> float:
        """Where the object is, along gravity [m]."""
        return float(self.data.xpos[self._body] @ self._down)

    @property
    def has_pedestal(self) -> bool:
        return self.item.pedestal > 0 and bool(self.model.geom_contype[self._pedestal])

    @property
    def _pedestal(self) -> int:
        return int(self.model.geom(PEDESTAL).id)

    def take_pedestal_away(self, *, away: bool = True) -> None:
        """Nothing touches it any more, and it is not seen; or (False) it is there again."""
        if self.item.pedestal > 0:
            self.model.geom_contype[self._pedestal] = self.model.geom_conaffinity[self._pedestal] = int(not away)
            self.model.geom_rgba[self._pedestal, 3] = float(not away)

    @contextmanager
    def show_pedestal(self, *, present: bool) -> Iterator[None]:
        """While a picture is rendered: with the pedestal, or without it."""
        before = self.has_pedestal
        self.take_pedestal_away(away=not present)
        yield
        self.take_pedestal_away(away=not before)

    # ---------------------------------------------------------------- results

    @property
    def sensors(self) -> tuple[str, ...]:
        """The frames that feel a wrench."""
        return tuple(self._sites)

    def pose(self, name: str) -> Pose:
        """world_from_frame, of an arm's tool or a pad."""
        return site_pose(self.data, self._sites[name])

    def wrench(self, name: str) -> FloatArray:
        """(6,) what the object does to a pad; to the tool of an arm, what it does to both pads; in its frame, about its
        origin [N, N m]."""
        wrenches: dict[str, FloatArray] = dict(zip(self._pads, self._pad_wrenches(), strict=True))
        if name in wrenches:
            return wrenches[name]
        here, total = self.pose(name), np.zeros(6)
        for pad, wrench in wrenches.items():
            if self._arm_of_pad[pad] == name:
                total += se3.transform_wrench(se3.relative_pose(here, self.pose(pad)), wrench)
        return total

    def _pad_wrenches(self) -> FloatArray:
        """(n, 6) of the object on each pad, about its origin, in its axes [N, N m]."""
        return self.touch.wrenches

    def normal_force(self, pad: str) -> float:
        """Positive when pressed [N]."""
        return -float(self._pad_wrenches()[list(self._pads).index(pad), 2])

    def surface(self, name: str) -> GelSurface:
        """The deformed surface of a pad's gel."""
        return self.touch.surface(self._pads[name])

    def slip_share(self, name: str) -> float:
        """Share of the limit of friction that a pad uses; 1: its object slides, or does not touch [-]."""
        return self.touch.slip_share(self._pads[name])

    def object_pose(self) -> Pose:
        """world_from_object."""
        return Pose(self.data.xpos[self._body], np.roll(self.data.xquat[self._body], -1))

    def object_speed(self) -> tuple[float, float]:
        """Of its origin [m/s], and of its rotation [rad/s]."""
        speed = np.zeros(6)
        mujoco = load_mujoco()
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_BODY, self._body, speed, 0)
        return float(np.linalg.norm(speed[3:])), float(np.linalg.norm(speed[:3]))

    def is_at_rest(self) -> bool:
        """The object hardly moves."""
        speed, turn = self.object_speed()
        return speed < tuning.REST_SPEED and turn < tuning.REST_TURN

    def diagnostics(self, name_of_pad: Mapping[str, str]) -> dict[str, float]:
        """Of each pad, by keys that end in its name: `max_force`, the greatest normal force since `begin` [N], and
        `slip_share`, see the method; and of arms with joints, how many steps were short of torque."""
        found = {}
        for pad, force in zip(self._pads, self._max_forces, strict=True):
            name = name_of_pad.get(pad, pad.replace("/", "_"))
            found[f"max_force_{name}"], found[f"slip_share_{name}"] = float(force), self.slip_share(pad)
        for name, arm in self.arms.items():
            if isinstance(arm, JointDrive):
                found[f"torque_limited_{name}"] = float(arm.limited)
        return found

    def place(self, arm: str, tool: Pose) -> None:
        """Puts an arm's tool elsewhere at once, at rest. Nothing may touch before or after."""
        drive = self.arms[arm]
        if isinstance(drive, JointDrive):
            drive.place(drive.find_joints(tool, drive.joints))
        else:
            drive.place(tool)
        self.refresh()

    def truth(self) -> Truth:
        here = self.object_pose()
        return Truth(
            height=float(rotated_bounding_size(self.item.geometry, here.quaternion)[2]),
            position=np.array(self.data.xipos[self._body]),
            points=se3.transform(here, self._points).astype(np.float32),
            poses={name: self.pose(name) for name in self._pads},
            objects={OBJECT: here},
            forces={name: self.normal_force(name) for name in self._pads},
        )

    # ------------------------------------------------------------------ state

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """A copy of the whole state, as named arrays."""
        state = self._gel_snapshot()
        for name, drive in self._drives():
            state |= {f"{name}:{key}": np.array(value) for key, value in drive.snapshot().items()}
        return state | {"cell": np.array([self._touched_at, self.has_pedestal, *self._max_forces])}

    def restore(self, state: State) -> None:
        """Raises ValueError if `state` is no snapshot of such a cell."""
        if "cell" not in state:
            raise ValueError("snapshot: 'cell' is missing; is it of another world?")
        self._touched_at = float(state["cell"][0])
        self.take_pedestal_away(away=not state["cell"][1])
        self._max_forces = np.array(state["cell"][2:])
        load_mujoco().mj_resetData(self.model, self.data)  # warnings, too, that a divergence has left
        self._restore_gels(state)
        for name, drive in self._drives():
            own = {key.removeprefix(f"{name}:"): value for key, value in state.items() if key.startswith(f"{name}:")}
            drive.restore(own)
        self.refresh()

    def _gel_snapshot(self) -> dict[str, NDArray[Any]]:
        """Of the gels and of MuJoCo."""
        return dict(self.touch.snapshot())

    def _restore_gels(self, state: State) -> None:
        self.touch.restore(state)

    def _drives(self) -> list[tuple[str, FreeDrive | JointDrive | GripperDrive]]:
        return [
            *((f"arms.{name}", arm) for name, arm in self.arms.items()),
            *((f"grippers.{name}", gripper) for name, gripper in self.grippers.items()),
        ]


def step_cells(cells: Sequence[Cell], time: float) -> list[PeriodError | None]:
    """One timestep, `time` [s] after their `begin`, of cells whose pads are in one list, in increasing order.

    Returns how each has failed: ObjectDropped; LimitExceeded for an object that reaches the housing of a gel, or that
    moves faster than the gels follow; SimulationDiverged. The others are not affected.
    """
    for cell in cells:
        cell.drive(time)
    failures: list[PeriodError | None] = []
    for cell, failure in zip(cells, step_each([cell.touch for cell in cells]), strict=True):
        if isinstance(failure, ValueError):  # the state is finite and fits: what else is refused is where the object is
            failures.append(LimitExceeded(str(failure)))
        elif failure is not None:
            failures.append(failure)
        else:
            try:
                cell.watch()
                failures.append(None)
            except ObjectDropped as dropped:
                failures.append(dropped)
    return failures


def grip_pose(scene: Scene) -> Pose:
    """world_from_tool where a gripper grips the object: at its centre or next to it, from above, closing along world
    x."""
    assert scene.object is not None
    return Pose(object_start(scene).position + scene.object.grip, se3.HALF_TURN_X.quaternion)


def surface_points(geometry: Any) -> Float32:
    """(n, 3) points of a shape's surface, in its frame [m]: of a box or cylinder on its edges, of a ball evenly, of a
    mesh its corners."""
    if isinstance(geometry, Mesh):
        return np.asarray(centred_mesh(geometry).vertices, np.float32)
    if isinstance(geometry, Sphere):
        number = np.arange(400) + 0.5
        z, angle = 1 - number / 200, math.pi * (1 + math.sqrt(5)) * number
        ring = np.sqrt(1 - z**2)
        return (geometry.radius * np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)).astype(np.float32)
    return edge_points(geometry, 0.5e-3).astype(np.float32)

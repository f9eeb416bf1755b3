"""A cell in which the object comes to rest in each control period: for learning, in a twentieth of the time."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim.control import NoTouch, ObjectDropped
from tacsim.interface import FloatArray, Pose
from tacsim.limits import LimitExceeded
from tacsim.models.scene import GelSurface, Scene
from tacsim.physics.grip.model import GripCommand, GuideSupport, HeldObject, HeldStates, Support
from tacsim.physics.grip.shared import GripPlace, SharedGrips
from tacsim.sim.cell import tuning
from tacsim.sim.cell.cell import PERIOD_ERRORS, Cell, PeriodError
from tacsim.sim.cell.description import ArmDescription, GripperDescription, ViewDescription
from tacsim.sim.cell.drives import State
from tacsim.sim.cell.grip import min_grip_force, require_enough
from tacsim.sim.cell.model import OBJECT, object_start
from tacsim.sim.engines.mujoco_module import load_mujoco

GripMotion = Generator[GripCommand, HeldStates, None]


class RestingCell(Cell):
    """As a Cell, but nothing has momentum: arms and fingers go where they are sent, and object and gels are solved
    together until they rest (tacsim.physics.grip). MuJoCo has the places of all for joints and pictures.

    Raises ValueError in addition for two grippers and for fixtures.
    """

    def __init__(
        self,
        scene: Scene,
        arms: Mapping[str, ArmDescription],
        grippers: Mapping[str, GripperDescription],
        views: Mapping[str, ViewDescription] | None = None,
        starts: Mapping[str, Pose] | None = None,
        place: GripPlace | None = None,
    ) -> None:
        """place: of its grip among those of other cells; None: it has a world of its own. The rest: see Cell."""
        self._place = GripPlace(SharedGrips(), 0) if place is None else place
        super().__init__(scene, arms, grippers, views, starts)

    def _add_gels(self) -> None:
        _require_free(self.scene, len(self.grippers))
        (self._gripper,) = self.grippers.values()
        item = HeldObject(self.item.geometry, self.item.mass, self.item.friction)
        self.held, self.grip_number = self._place.fill(item, self.scene), self._place.index
        self._joint = int(self.model.joint(OBJECT).qposadr[0])
        self._states: HeldStates | None = None  # None: not put in place since the cell was made or rewound

    # ------------------------------------------------------------------- time

    def grip(self, force: float) -> None:
        """Closes the gripper around the object with a force [N], takes away what it stands on, and lifts it.

        Raises NoTouch where it is not held, LimitExceeded for an object that reaches the housing of a gel.
        """
        require_enough(self, force, len(self.grippers))
        self._put_in_place()
        width = self._gripper.width
        try:
            guide = self._guide(0.0)
            self._take(self.held.grasp(self._pad_poses()[None], [force], self.grip_number, guide=guide), width)
        except ValueError as failure:
            raise LimitExceeded(str(failure)) from failure
        self._gripper.command(0.0, force)
        self.take_pedestal_away()
        if self.item.lift:
            (arm,) = self.arms
            here = self.pose(arm)
            self.move({arm: Pose(here.position + [0.0, 0.0, self.item.lift], here.quaternion)}, 0.0, settle=True)
        states = self._states
        assert states is not None
        if not states.at_rest[0] or not states.touching[0].all():
            raise NoTouch(
                f"a grip of {force:.4g} N does not hold the object at rest: forces are out of balance by "
                f"{float(states.imbalances[0]):.2g} of the largest; grip it with more touch_force, or nearer to its "
                "centre of mass"
            )

    def move(self, targets: Mapping[str, Pose], seconds: float, *, settle: bool) -> None:
        """One control period. Raises ObjectDropped, LimitExceeded for a pose out of reach or an object on the housing
        of a gel, and SimulationDiverged."""
        (failure,) = move_together([self], [self.motion(targets, seconds)], settle=settle)
        if failure is not None:
            raise failure

    def motion(self, targets: Mapping[str, Pose], seconds: float) -> GripMotion:
        """`move` in parts: yields the command of its grip, and is sent its state after that; an error is thrown into
        it. Raises as `move`."""
        if self._states is None:
            self._put_in_place()
        for arm, target in targets.items():
            self.place(arm, target)
        (width, force), here = self._gripper.target, self._gripper.width
        max_change = 2 * self._gripper.max_speed * seconds
        try:
            if width < here:
                before = self.held.snapshot(self.grip_number)
                states, from_width = (yield self._command(here, force, seconds)), here
                if here - 2 * float(states.closings[0]) < width:  # it meets nothing before its width
                    self.held.restore(self.grip_number, before)
                    from_width = max(width, here - max_change)
                    states = yield self._command(from_width, None, seconds)
            else:
                from_width = min(width, here + max_change)
                states = yield self._command(from_width, None, seconds)
        except ValueError as failure:
            raise LimitExceeded(str(failure)) from failure
        self._take(states, from_width)
        self.data.time += seconds
        if states.dropped[0] and self.item.guide is None:
            raise ObjectDropped(
                f"the object was dropped: no pad touches it any more. Two pads hold {self.item.mass:.3g} kg still with "
                f"at least {min_grip_force(self, len(self.grippers)):.3g} N each"
            )

    def _put_in_place(self) -> None:
        here = self.object_pose()
        self.held.reset([*here.position, *here.quaternion], self._pad_poses(), self.grip_number)
        self._states = self.held.state_of(self.grip_number)

    def _command(self, width: float, force: float | None, seconds: float) -> GripCommand:
        """force: from `width` the pads close until they press with it [N]; None: they stay there. seconds: of the
        period."""
        self._gripper.set_width(width)
        self.refresh()
        pedestal = Support(tuning.PEDESTAL_STIFFNESS) if self.has_pedestal else None
        return GripCommand(self._pad_poses(), force, self._guide(seconds) or pedestal)

    def _guide(self, seconds: float) -> GuideSupport | None:
        """The object's guide in a period; 0 s: without its damper."""
        guide = self.item.guide
        if guide is None:
            return None
        travel, drag = float(self.data.qpos[self._joint]), guide.damping / seconds if seconds else 0.0
        return GuideSupport("xyz".index(guide.axis), guide.friction, drag, (-travel, guide.travel - travel))

    def _pad_poses(self) -> FloatArray:
        """(2, 7)"""
        poses = [self.pose(pad) for pad in self._pads]
        return np.array([[*pose.position, *pose.quaternion] for pose in poses])

    def _take(self, states: HeldStates, width: float) -> None:
        """Puts object and fingers where they are after a step from `width`."""
        self._states = states
        place, guide = states.objects[0], self.item.guide
        if guide is None:
            self.data.qpos[self._joint : self._joint + 7] = [*place[:3], *np.roll(place[3:], 1)]
        else:
            axis = "xyz".index(guide.axis)
            self.data.qpos[self._joint] = place[axis] - object_start(self.scene).position[axis]
        self._gripper.set_width(width - 2 * float(states.closings[0]))
        self._gripper.force = float(np.mean([self.normal_force(pad) for pad in self._pads]))
        self._max_forces = np.maximum(0.0, -states.wrenches[0, :, 2])
        self.refresh()

    # ---------------------------------------------------------------- results

    def _pad_wrenches(self) -> FloatArray:
        return np.zeros((len(self._pads), 6)) if self._states is None else self._states.wrenches[0]

    def surface(self, name: str) -> GelSurface:
        return self.held.surface(self.grip_number, list(self._pads).index(name))

    def slip_share(self, name: str) -> float:
        return 1.0 if self._states is None else float(self._states.slip_shares[0, list(self._pads).index(name)])

    def object_speed(self) -> tuple[float, float]:
        return 0.0, 0.0

    # ------------------------------------------------------------------ state

    def _gel_snapshot(self) -> dict[str, NDArray[Any]]:
        held = {f"held/{name}": value for name, value in self.held.snapshot(self.grip_number).items()}
        return {"qpos": self.data.qpos.copy(), "time": np.array([self.data.time]), **held}

    def _restore_gels(self, state: State) -> None:
        own = {name.removeprefix("held/"): v for name, v in state.items() if name.startswith("held/")}
        self.held.restore(self.grip_number, own)
        self.data.qpos[:], self.data.time = state["qpos"], float(state["time"][0])
        self._states = self.held.state_of(self.grip_number) if bool(state["held/placed"].any()) else None
        load_mujoco().mj_forward(self.model, self.data)


def move_together(
    cells: Sequence[RestingCell], motions: Sequence[GripMotion], *, settle: bool
) -> list[PeriodError | None]:
    """Carries out motions of cells that share one world of grips, in common launches; one that fails leaves the others
    alone. Returns how each has failed."""
    failures: list[PeriodError | None] = [None] * len(cells)
    wanted: dict[int, GripCommand] = {}

    def resume(number: int, go_on: Callable[[], GripCommand]) -> None:
        """Runs a motion to its next launch, or to its end."""
        try:
            wanted[number] = go_on()
        except StopIteration:
            pass
        except PERIOD_ERRORS as failure:
            failures[number] = failure

    for number, motion in enumerate(motions):
        resume(number, partial(next, motion))
    while wanted:
        commands = {cells[number].grip_number: command for number, command in wanted.items()}
        waiting, wanted = list(wanted), {}
        ends = cells[0].held.step_each(commands, settle=settle)
        for number in waiting:
            end, motion = ends[cells[number].grip_number], motions[number]
            resume(number, partial(motion.send, end) if isinstance(end, HeldStates) else partial(motion.throw, end))
    return failures


def _require_free(scene: Scene, grippers: int) -> None:
    wrong = {f"{grippers} grippers": grippers != 1, "fixtures": bool(scene.fixtures)}
    for what, is_there in wrong.items():
        if is_there:
            raise ValueError(
                f"motion settled or flowing takes one gripper and no fixtures, and here are {what}: use motion dynamic"
            )

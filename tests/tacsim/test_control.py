"""Control of an arm on any rig: the contact signal, the approach until touch, guards of the gels, constant load."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robot.open import open_rig
from tacsim import pose as se3
from tacsim.config import ConfigError, load_rig
from tacsim.control import (
    LOAD_TOLERANCE,
    MAX_TRAVEL,
    GelMonitor,
    LoadController,
    NoTouch,
    approach,
    contact_signal,
    load_controller,
    pixel_mask,
)
from tacsim.interface import Action, ArmState, GelReading, Pose, SensorSpec, TactileObservation
from tacsim.limits import LimitExceeded
from tacsim.models.limits import ArmLimits, Workspace
from tacsim.models.task import RepositionConfig, SqueezeConfig


def _observation(image: np.ndarray, valid: np.ndarray) -> TactileObservation:
    return TactileObservation(
        image=image, gradient=None, height=None, contact=np.zeros_like(valid), valid=valid, flow=None, time=0.0, age=0.0
    )


def test_signal_is_the_mean_relative_change_over_valid_pixels() -> None:
    image = np.full((8, 12, 3), 128, dtype=np.uint8)
    valid = np.ones((4, 6), dtype=bool)
    assert contact_signal(_observation(image, valid)) == 0.0
    image[:2, :, 0] = 128 + 64  # a quarter of the rows, one channel of three, half of mean(I0)
    assert contact_signal(_observation(image, valid)) == pytest.approx(0.5 / 4 / 3)
    image[:2, :, 0] = 128 - 64  # darker counts as much
    assert contact_signal(_observation(image, valid)) == pytest.approx(0.5 / 4 / 3)
    valid[0] = False  # the changed rows are no gel
    assert contact_signal(_observation(image, valid)) == 0.0


def test_no_valid_pixel_is_an_error() -> None:
    with pytest.raises(ValueError, match="no valid pixel"):
        contact_signal(_observation(np.zeros((8, 8, 3), dtype=np.uint8), np.zeros((4, 4), dtype=bool)))


def test_mask_needs_whole_cells() -> None:
    cells = np.array([[True, False], [False, False]])
    np.testing.assert_array_equal(pixel_mask(cells, (4, 4))[:2, :2], True)
    assert pixel_mask(cells, (4, 4)).sum() == 4
    with pytest.raises(ValueError, match="no whole multiple"):
        pixel_mask(cells, (4, 5))


@pytest.mark.parametrize(("surface", "steps"), [(0.0, []), (2.5, [1.0, 2.0, 3.0])])
def test_an_approach_ends_at_the_first_step_that_touches(surface: float, steps: list[float]) -> None:
    went: list[float] = []
    assert approach(lambda: max(went, default=0.0) >= surface, went.append, 1.0, 5.0, "") == max(steps, default=0.0)
    assert went == steps


def test_an_approach_that_meets_nothing_ends_at_its_bound() -> None:
    went: list[float] = []
    with pytest.raises(NoTouch, match=r"no touch after an approach of 2.5e[+]03 mm; look"):
        approach(lambda: False, went.append, 1.0, 2.5, "look")
    assert went == [1.0, 2.0]


BOX = Workspace(lower=(-1.0, -1.0, -1.0), upper=(1.0, 1.0, 1.0))


def limits(depth: float | None = None, shear: float | None = None) -> ArmLimits:
    return ArmLimits(workspace=BOX, depth=depth, shear=shear)


def sensors(height: bool = True, flow: bool = True) -> dict[str, SensorSpec]:
    return {name: SensorSpec((4, 4), height, flow, name) for name in ("lower", "upper")}


def touch(depth: float, drag: float, hidden: float = 0.0, time: float = 0.0) -> TactileObservation:
    height = np.zeros((4, 4), np.float32)
    valid = np.ones((4, 4), bool)
    height[1, 1], height[3, 3], valid[3, 3] = depth, hidden, False
    flow = np.zeros((2, 2, 2), np.float32)
    flow[0, 1] = (0.6 * drag, -0.8 * drag)
    flow[1, 1] = np.nan  # a marker that was lost
    image = np.zeros((4, 4, 3), np.uint8)
    return TactileObservation(
        image,
        gradient=np.zeros((4, 4, 2), np.float32),
        height=height,
        contact=valid,
        valid=valid,
        flow=flow,
        time=time,
        age=0.0,
    )


def blind() -> TactileObservation:
    seen = touch(0.0, 0.0)
    return TactileObservation(
        seen.image, gradient=None, height=None, contact=seen.contact, valid=seen.valid, flow=None, time=0.0, age=0.0
    )


def test_a_gel_pressed_or_dragged_too_far_ends_the_episode() -> None:
    watch = GelMonitor(sensors(), {"upper": limits(1e-3, 0.5e-3)}, {})
    good = touch(0.9e-3, 0.4e-3, hidden=5e-3)
    watch({"lower": touch(3e-3, 3e-3), "upper": good})  # nothing was said of the lower arm
    with pytest.raises(LimitExceeded, match=r"sensor 'upper': depth 1\.1 mm, limits\.depth of arm 'upper' is 1 mm"):
        watch({"lower": good, "upper": touch(1.1e-3, 0.0)})
    with pytest.raises(LimitExceeded, match=r"shear 0\.6 mm"):
        watch({"lower": good, "upper": touch(0.0, 0.6e-3)})


def test_what_is_watched_and_cannot_be_seen_is_too_much() -> None:
    watch = GelMonitor(sensors(), {"upper": limits(depth=1e-3)}, {})
    with pytest.raises(LimitExceeded, match=r"depth is not measured"):
        watch({"lower": touch(0.0, 0.0), "upper": blind()})


def test_arms_are_told_before_anything_is_raised() -> None:
    told: dict[str, GelReading] = {}
    tell = {name: lambda shown, name=name: told.__setitem__(name, shown) for name in ("lower", "upper")}
    watch = GelMonitor(sensors(), {"lower": limits(depth=1e-3)}, tell)
    with pytest.raises(LimitExceeded):
        watch({"lower": touch(2e-3, 1e-4, time=5.0), "upper": touch(3e-4, 2e-4, time=4.0)})
    assert told["lower"].depth == pytest.approx(2e-3)
    assert told["upper"].shear == pytest.approx(2e-4)
    assert told["lower"].exposed == told["upper"].exposed == 4.0  # the oldest picture of the rig
    watch({"lower": touch(1e-4, 0.0), "upper": blind()})
    assert math.isnan(told["upper"].depth)


def test_a_limit_that_no_sensor_can_tell_is_refused() -> None:
    with pytest.raises(ValueError, match=r"arms\.upper\.limits\.depth: sensor 'upper' does not measure it"):
        GelMonitor(sensors(height=False), {"upper": limits(depth=1e-3)}, {})
    with pytest.raises(ValueError, match=r"arms\.lower\.limits\.shear"):
        GelMonitor(sensors(flow=False), {"lower": limits(shear=1e-3)}, {})


STIFFNESS, LOAD, LONGEST = 3e3, 2.0, 0.2e-3  # [N/m], [N], [m]


class Wall:
    """One sensor against an elastic wall across its z; it goes where it is sent."""

    def __init__(self, stiffness: float = STIFFNESS, start: Pose | None = None, noise: float = 0.0) -> None:
        self.stiffness, self.noise = stiffness, noise
        self.start = self.pose = Pose() if start is None else start
        self.rng = np.random.default_rng(3)

    @property
    def depth(self) -> float:
        return float(se3.relative_pose(self.start, self.pose).position[2])

    @property
    def force(self) -> float:
        return max(0.0, 1.0 + self.stiffness * self.depth)

    def state(self) -> ArmState:
        felt = np.array([0.0, 0.0, -self.force + self.noise * self.rng.standard_normal(), 0.0, 0.0, 0.0])
        return ArmState(self.pose, np.zeros(6), felt, None, 0.0)

    def period(self, held: LoadController, asked: Pose | None, share: float = 1.0) -> None:
        """share: of the way that its limits leave."""
        target = held(Action({"hand": asked}), {"hand": self.state()}).tool["hand"]
        assert target is not None
        self.pose = se3.interpolate_pose(self.pose, target, share)
        held.record_sent_poses({"hand": self.pose})


def holding(load: float = LOAD) -> LoadController:
    return LoadController({"hand": load}, LONGEST)


@pytest.mark.parametrize("stiffness", [300.0, 3e3, 3e4])
@pytest.mark.parametrize("load", [0.3, 2.0])
def test_a_load_is_reached_and_then_rests(stiffness: float, load: float) -> None:
    wall, held = Wall(stiffness), holding(load)
    way = abs(load - 1.0) / stiffness
    for _ in range(6 + int(way / LONGEST)):
        wall.period(held, None)
    assert wall.force == pytest.approx(load, rel=LOAD_TOLERANCE)
    rests = wall.pose
    wall.period(held, None)
    assert np.array_equal(wall.pose.position, rests.position)


def test_only_the_way_along_z_of_the_sensor_is_replaced() -> None:
    turned = Rotation.from_rotvec([0.3, -0.2, 0.7])
    wall, held = Wall(start=Pose(np.array([0.1, 0.2, 0.3]), turned.as_quat())), holding()
    x, _, z = turned.as_matrix().T
    for count in range(1, 9):
        wall.period(held, Pose(wall.start.position + count * 0.1e-3 * x - 0.4e-3 * z, turned.as_quat()))
        moved = se3.relative_pose(wall.start, wall.pose).position
        assert moved[:2] == pytest.approx([count * 0.1e-3, 0.0], abs=1e-12)
    assert wall.force == pytest.approx(LOAD, rel=LOAD_TOLERANCE)


def test_no_correction_is_longer_than_allowed() -> None:
    wall, held = Wall(100.0), holding()
    for _ in range(20):
        before = wall.depth
        wall.period(held, None)
        assert abs(wall.depth - before) <= LONGEST * (1 + 1e-9)


def test_noise_of_the_force_does_not_build_up() -> None:
    wall, held = Wall(noise=0.1), holding()
    forces = []
    for _ in range(200):
        wall.period(held, None)
        forces.append(wall.force)
    assert np.mean(forces[20:]) == pytest.approx(LOAD, abs=0.1)
    assert np.std(forces[20:]) < 0.25


def test_what_limits_shorten_is_not_wound_up() -> None:
    wall, held = Wall(), holding()
    for _ in range(50):
        wall.period(held, None, share=0.0)  # nothing is let through
    depths = []
    for _ in range(10):
        wall.period(held, None)
        depths.append(wall.depth)
    assert max(depths) <= (LOAD - 1.0) / STIFFNESS * 1.5
    assert wall.force == pytest.approx(LOAD, rel=LOAD_TOLERANCE)


def test_an_arm_with_nothing_to_press_stops_and_says_so() -> None:
    wall, held = Wall(stiffness=0.0), holding()
    for _ in range(249):  # corrections of a tenth of the longest, as no stiffness shows
        wall.period(held, None)
    with pytest.raises(LimitExceeded, match=r"'hand' does not reach its load of 2 N: it feels 1 N after \+5.* mm"):
        _twice(wall, held)
    assert 0.9 * MAX_TRAVEL < wall.depth <= MAX_TRAVEL
    held.reset()
    wall.period(held, None)  # a new episode begins anew


def _twice(wall: Wall, held: LoadController) -> None:
    wall.period(held, None)
    wall.period(held, None)


@pytest.mark.parametrize("felt", [np.nan, np.inf])
def test_a_force_that_is_no_number_moves_nothing(felt: float) -> None:
    state = ArmState(Pose(), np.zeros(6), np.array([0.0, 0.0, felt, 0.0, 0.0, 0.0]), None, 0.0)
    with pytest.raises(LimitExceeded, match=r"but feels (nan|-?inf) N"):
        holding()(Action({}), {"hand": state})


def test_only_tasks_that_name_loads_hold_them() -> None:
    assert load_controller(None) is None
    assert load_controller(SqueezeConfig(kind="squeeze")) is None
    assert load_controller(RepositionConfig(kind="reposition")) is None
    held = load_controller(RepositionConfig(kind="reposition", loads={"upper": 2.0}))
    assert held is not None and held.loads == {"upper": 2.0}


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("task.loads={uper: 2 N}", "no arm 'uper'; allowed: lower, upper"),
        ("task.loads={upper: 0 N}", "out of range"),
        ("task.loads={upper: 2 mm}", "force"),
    ],
)
def test_rig_files_name_loads_of_their_arms(override: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_rig("sim", task="reposition", overrides=[override])


def test_a_load_at_which_the_arm_stops_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"task\.loads\.upper: arm 'upper' stops at limits\.force, 60 N"):
        load_rig("mock", task="reposition", overrides=["task.loads={upper: 60 N}"])


def test_a_rig_holds_the_load_whatever_the_policy_asks_along_z(open_springs: Callable[..., Any]) -> None:
    rig = open_springs("reposition", "task.loads={upper: 2 N}")
    before = rig.reset().arms["upper"]
    assert -before.wrench[2] == pytest.approx(1.0, rel=0.2)  # touch_force
    for count in range(1, 8):
        asked = Pose(before.pose.position + [count * 0.1e-3, 0.0, 1e-3], before.pose.quaternion)
        observation, sent = rig.step(Action({"upper": asked}))
    arm = observation.arms["upper"]
    assert -arm.wrench[2] == pytest.approx(2.0, rel=LOAD_TOLERANCE)
    assert arm.pose.position[:2] == pytest.approx(before.pose.position[:2] + [0.7e-3, 0.0], abs=1e-9)
    assert sent["upper"] is not None and sent["upper"].position[2] == arm.pose.position[2]
    rig.step(Action())  # an arm that the policy holds goes on holding its load
    assert np.array_equal(rig.reset().arms["upper"].pose.position, before.pose.position)


@pytest.mark.slow
def test_the_gels_hold_it_too_while_the_body_is_dragged() -> None:
    config = load_rig("sim", task="reposition", overrides=["task.loads={upper: 2 N}", "task.scene.preset=draft"])
    forces = []
    with open_rig(config) as rig:
        arm = rig.reset().arms["upper"]
        for count in range(1, 9):
            asked = Pose(arm.pose.position + [count * 0.1e-3, 0.0, 0.0], arm.pose.quaternion)
            observation, _ = rig.step(Action({"upper": asked}))
            forces.append(-observation.arms["upper"].wrench[2])
    assert forces[3:] == pytest.approx([2.0] * 5, rel=0.03)

"""How an episode begins on hardware, with arms and clocks of the tests' own: the order of things, and what stops it."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field

import numpy as np
import pytest

from robot.errors import DeviceError, EmergencyStop
from robot.rig import reset as resets
from robot.rig.commanded_arm import CommandedArm
from robot.rig.reset import RETREAT_DISTANCE, HardwareReset, NotConfirmed, Touch
from tacsim import pose as se3
from tacsim.control import NoTouch
from tacsim.interface import ArmState, Pose, SensorSpec, TactileFrame
from tacsim.models.hardware import ResetConfig

LOWER, UPPER = Pose(np.array([0.0, 0.0, -0.02])), Pose(np.array([0.0, 0.0, 0.03]), np.array([1.0, 0.0, 0.0, 0.0]))
PARAMS = ResetConfig(approach_step=1e-3, approach_distance=10e-3, approach_speed=20e-3)


class StubArm:
    """Is at once where it is sent; tells the log."""

    def __init__(self, name: str, pose: Pose, log: list[object]) -> None:
        self.name, self.pose, self._log = name, pose, log
        self.stopped = False
        self.reported: object = "the last tactile values"

    def report_tactile(self, shown: object) -> None:
        self.reported = shown

    def state(self, at: float | None = None) -> ArmState:
        return ArmState(self.pose, np.zeros(6), np.zeros(6), np.zeros(6), 0.0)

    def command(self, target: Pose | None, speed: float | None = None) -> Pose | None:
        if target is None:
            self._log.append((self.name, "hold"))
            return None
        if self.stopped:
            raise EmergencyStop(f"arm '{self.name}' has an emergency stop")
        away = target.position - self.pose.position
        if speed is not None and (length := float(np.linalg.norm(away))) > 1e-3:  # a look later it is a bit nearer
            self.pose = Pose(self.pose.position + away * (1e-3 / length), target.quaternion)
        else:
            self.pose = target
        self._log.append((self.name, target))
        return target

    def arrived(self, target: Pose, **within: float) -> bool:
        return se3.pose_distance(self.pose, target)[0] < 1e-9

    def at_rest(self) -> bool:
        return True

    def explain(self) -> str:
        return f"arm '{self.name}' stands still"

    def stop(self) -> None:
        self._log.append((self.name, "stop"))

    def zero_wrench(self) -> None:
        self._log.append((self.name, "zero"))


class StubSensor:
    spec = SensorSpec(image_shape=(4, 4), height=False, flow=False, arm=None)

    def __init__(self, log: list[object]) -> None:
        self._log = log
        self.late = 0  # reads that still give a picture exposed before anything moved

    def read(self, timeout: float) -> TactileFrame:
        self._log.append("reference")
        self.late -= 1
        return TactileFrame(np.zeros((4, 4, 3), np.uint8), time=0.0 if self.late >= 0 else time.monotonic(), index=0)

    def close(self) -> None: ...


@dataclass
class Scene:
    """A start, and all that happened."""

    touch_at: float | None = None  # how far both must come until they touch [m]
    yes: bool = True
    arms: bool = True
    placement: float = 0.0
    log: list[object] = field(default_factory=list)
    reports: list[str] = field(default_factory=list)
    real_time = False
    data_timeout = 0.1

    def __post_init__(self) -> None:
        self.lower, self.upper = StubArm("lower", LOWER, self.log), StubArm("upper", UPPER, self.log)
        self.sensor = StubSensor(self.log)
        commanded = {"lower": CommandedArm(self.lower), "upper": CommandedArm(self.upper)}  # type: ignore[arg-type]
        self.reset = HardwareReset(
            arms=commanded if self.arms else {},
            sensors={"finger": self.sensor},
            start={"lower": LOWER, "upper": UPPER},
            clock=self,
            config=PARAMS,
            touch_sensing=None if self.touch_at is None else self,
            confirm=self.confirm,
            placement=self.placement,
            report=self.reports.append,
        )

    def wait_for_data(self) -> None:
        self.log.append("wait")

    def restart(self) -> None:
        self.log.append("restart")

    def confirm(self) -> bool:
        self.log.append("asked")
        return self.yes

    def measure_touch(self, *, guarded: bool) -> Touch:
        assert self.touch_at is not None and not guarded
        gone = float(self.lower.pose.position[2] - LOWER.position[2])
        return Touch({"lower": gone / self.touch_at, "upper": gone / self.touch_at}, 0.0)

    def motions(self) -> list[tuple[str, Pose]]:
        return [each for each in self.log if isinstance(each, tuple) and isinstance(each[1], Pose)]


@pytest.fixture(autouse=True)
def no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resets.time, "sleep", lambda seconds: None)


def test_reset_retreats_along_axis_then_moves_to_start() -> None:
    scene = Scene()
    scene.lower.pose, scene.upper.pose = (
        Pose(np.array([5e-3, 0, 0])),
        Pose(np.array([5e-3, 0, 10e-3]), UPPER.quaternion),
    )
    scene.reset.clear(0)
    assert scene.lower.reported is scene.upper.reported is None  # old tactile values are not used
    back = dict(scene.motions()[:2])
    assert back["lower"].position == pytest.approx([5e-3, 0, -RETREAT_DISTANCE])
    assert back["upper"].position == pytest.approx([5e-3, 0, 10e-3 + RETREAT_DISTANCE])  # it faces down
    there = dict(scene.motions()[2:])
    assert se3.pose_distance(there["lower"], LOWER)[0] == se3.pose_distance(there["upper"], UPPER)[0] == 0.0


def test_reset_zeroes_present_force_then_reads_references() -> None:
    scene = Scene()
    scene.reset.clear(0)
    assert scene.log[4:] == ["wait", ("lower", "zero"), ("upper", "zero"), "wait", "reference"]


def test_reset_reference_is_exposed_at_rest() -> None:
    """A camera that was held up still has one of before; at that time an arm may not even have been connected."""
    scene, before = Scene(), time.monotonic()
    scene.sensor.late = 3
    assert scene.reset.clear(0)["finger"].time >= before
    assert scene.log[-5:] == ["wait", *["reference"] * 4]


def test_reset_without_new_image_raises_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resets, "FRAME_TIMEOUT", 0.0)
    scene = Scene()
    scene.sensor.late = 10**9
    with pytest.raises(TimeoutError, match="sensor 'finger': no image since the arms came to rest"):
        scene.reset.clear(0)


def test_reset_placement_depends_on_seed_and_is_equal_for_arms() -> None:
    found = []
    for seed in (3, 3, 4):
        scene = Scene(placement=2e-3)
        scene.reset.clear(seed)
        shifts = [
            pose.position - there.position for (_, pose), there in zip(scene.motions()[2:], (LOWER, UPPER), strict=True)
        ]
        np.testing.assert_array_equal(shifts[0], shifts[1])
        assert shifts[0][2] == 0.0 and 0.0 < np.abs(shifts[0][:2]).max() <= 2e-3
        found.append(shifts[0])
    assert np.array_equal(found[0], found[1]) and not np.array_equal(found[0], found[2])


def test_approach_by_steps_ends_at_touch_of_each_arm() -> None:
    scene = Scene(touch_at=3.5e-3)
    scene.reset.clear(0)
    before = len(scene.motions())
    scene.reset.touch()
    steps = scene.motions()[before:]
    lower = [pose.position[2] - LOWER.position[2] for name, pose in steps if name == "lower"]
    upper = [UPPER.position[2] - pose.position[2] for name, pose in steps if name == "upper"]
    assert lower == pytest.approx([1e-3, 2e-3, 3e-3, 4e-3])
    assert upper == pytest.approx(lower)
    assert scene.log[-1] == "restart"
    assert scene.log.index("asked") < scene.log.index(steps[0])


def test_touch_without_confirmation_moves_no_arm() -> None:
    scene = Scene(touch_at=1e-3, yes=False)
    scene.reset.clear(0)
    before = len(scene.motions())
    with pytest.raises(NotConfirmed, match="no arm approaches"):
        scene.reset.touch()
    assert len(scene.motions()) == before and "restart" not in scene.log


def test_approach_by_steps_without_touch_returns_to_start() -> None:
    scene = Scene(touch_at=1.0)
    scene.reset.clear(0)
    with pytest.raises(NoTouch, match=r"no touch after an approach of 1[01] mm.*back at their start"):
        scene.reset.touch()
    assert scene.lower.pose.position == pytest.approx(LOWER.position)
    assert scene.upper.pose.position == pytest.approx(UPPER.position)
    farthest = max(pose.position[2] for name, pose in scene.motions() if name == "lower")
    assert 8e-3 < farthest - LOWER.position[2] <= PARAMS.approach_distance + 1e-9  # never beyond


def test_reset_with_stopped_arm_raises() -> None:
    scene = Scene(touch_at=1.0)
    scene.upper.stopped = True
    with pytest.raises(EmergencyStop):
        scene.reset.clear(0)
    assert "reference" not in scene.log


def test_reset_in_dry_run_asks_and_observes_without_motion() -> None:
    scene = Scene(arms=False, touch_at=1.0)
    scene.reset.clear(0)
    scene.reset.touch()
    assert scene.reports == []
    assert scene.motions() == [] and ("lower", "zero") not in scene.log
    assert scene.log == ["wait", "reference", "asked", "wait", "restart"]


class Moving(Scene):
    """Pictures come as things happen: both go on until each has touched for itself."""

    real_time = True
    walls: dict[str, float]  # how far each must come until it touches [m]
    silent = False
    looks = 0

    def measure_touch(self, *, guarded: bool) -> Touch:
        assert guarded
        self.looks += 1
        assert self.looks < 200
        gone = {"lower": self.lower.pose.position[2] - LOWER.position[2]}
        gone["upper"] = UPPER.position[2] - self.upper.pose.position[2]
        pressed = {name: float(way) / self.walls[name] for name, way in gone.items()}
        return Touch(pressed, -math.inf if self.silent else math.inf)


@pytest.fixture
def moving() -> Moving:
    scene = Moving(touch_at=1.0)
    scene.walls = {"lower": 2e-3, "upper": 5e-3}
    scene.reset.clear(0)
    return scene


def test_approach_stops_each_arm_at_its_touch(moving: Moving) -> None:
    moving.reset.touch()
    assert moving.lower.pose.position[2] - LOWER.position[2] == pytest.approx(2e-3)
    assert UPPER.position[2] - moving.upper.pose.position[2] == pytest.approx(5e-3)
    assert moving.log[-1] == "restart"


def test_approach_without_new_images_waits(moving: Moving, monkeypatch: pytest.MonkeyPatch) -> None:
    moving.silent = True
    monkeypatch.setattr(resets, "MOVE_TIMEOUT", 0.0)  # gives up at once
    with pytest.raises(DeviceError, match="made no progress for 0 s: no new images"):
        moving.reset.touch()
    assert moving.lower.pose.position == pytest.approx(LOWER.position)
    assert ("lower", "stop") in moving.log and ("upper", "stop") in moving.log


def test_slow_approach_continues_while_it_progresses(moving: Moving, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resets, "MOVE_TIMEOUT", 0.0)  # less than the whole takes
    moving.reset.touch()
    assert moving.log[-1] == "restart"


def test_approach_nan_signal_counts_as_touch(moving: Moving) -> None:
    moving.walls["lower"] = math.nan
    moving.reset.touch()
    assert moving.lower.pose.position == pytest.approx(LOWER.position)


def test_approach_error_stops_arms(moving: Moving, monkeypatch: pytest.MonkeyPatch) -> None:
    del moving.walls["upper"]
    with pytest.raises(KeyError):
        moving.reset.touch()
    moving.walls["upper"] = 1.0
    monkeypatch.setattr(moving.reset, "_report", lambda words: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        moving.reset.touch()
    assert moving.log[-2:] == [("lower", "stop"), ("upper", "stop")]


def test_approach_without_touch_returns_to_start(moving: Moving, monkeypatch: pytest.MonkeyPatch) -> None:
    moving.walls = {"lower": 1.0, "upper": 1.0}
    monkeypatch.setattr(resets, "END_TIMEOUT", 0.0)
    with pytest.raises(NoTouch, match=r"no touch after an approach of 10 mm.*back at their start"):
        moving.reset.touch()
    assert moving.lower.pose.position == pytest.approx(LOWER.position)
    assert moving.upper.pose.position == pytest.approx(UPPER.position)
    assert moving.lower.reported is None  # old tactile values do not guard the motion back
    assert moving.reports[-1] == "back to the start" and "approach: 10.0 mm of at most 10 mm" in moving.reports

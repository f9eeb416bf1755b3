"""A rig of hardware over mocks: what reaches the wire, and what stops it.

One rig is shared by these tests, and each leaves it as it found it.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

import robot.rig.reset
from robot.arm.time_alignment import NotAligned, await_state_at
from robot.camera.camera import StaleFrame
from robot.errors import DeviceError, EmergencyStop, ProtectiveStop, SafetyViolation
from robot.open import open_rig
from robot.rig.commanded_arm import CommandedArm
from robot.rig.reset import NotConfirmed
from tacsim.interface import Action, ArmState, Pose
from tests.robot.rig.bare_rig import Opened, bare_file, failing, opened
from tests.robot.waiting import until

pytestmark = pytest.mark.usefixtures("no_pause")
SERVOJ = 11


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Opened]:
    with opened(bare_file(tmp_path_factory.mktemp("bare"))) as found:
        yield found


@pytest.fixture
def bare(shared: Opened) -> Opened:
    shared.rig.reset()
    return shared


@pytest.mark.slow
def test_rig_step_moves_arm_to_target(bare: Opened) -> None:
    observation = bare.rig.observe()
    start = observation.arms["right"].pose
    target = Pose(start.position + [1e-3, 0.0, 0.0], start.quaternion)
    since = bare.now()
    _, sent = bare.rig.step(Action({"right": target}))
    assert sent["right"] is not None and sent["right"].position == pytest.approx(target.position)
    assert sent["left"] is None
    for _ in range(40):
        observation, _ = bare.rig.step(Action({"right": target}))
    assert observation.arms["right"].pose.position == pytest.approx(target.position, abs=50e-6)
    assert SERVOJ in bare.received(since)["right"]
    assert observation.arms["left"].pose.position == pytest.approx([0, 0, 0], abs=50e-6)


def test_rig_arms_keep_their_distance(bare: Opened) -> None:
    """Both are asked to meet in the middle."""
    arms = bare.rig.observe().arms
    middle = np.array([0.0, 0.0, 15e-3])
    towards = Action({name: Pose(middle, arm.pose.quaternion) for name, arm in arms.items()})
    gaps = []
    for _ in range(12):
        try:
            observation, sent = bare.rig.step(towards)
        except SafetyViolation as stopped:
            pytest.fail(f"the guard that comes before the stop did not hold: {stopped}")
        places = {name: arm.pose.position for name, arm in observation.arms.items()}
        gaps.append(float(np.linalg.norm(places["right"] - places["left"])))
        assert all(pose is not None and np.abs(pose.position - middle).max() > 1e-3 for pose in sent.values())
    assert min(gaps) > 19.9e-3  # to the arm's own precision
    assert gaps[-1] < 29e-3  # they did go as far as they may


def test_rig_reports_tactile_values_from_first_observation(bare: Opened) -> None:
    channels = [arm.driver._channel for arm in bare.rig.arms.values()]  # type: ignore[attr-defined]
    observation, _ = bare.rig.step(Action())
    oldest = min(touch.time for touch in observation.tactile.values())
    shown = [channel.tactile.latest() for channel in channels]
    assert [float(touch["exposed"]) for touch in shown] == [oldest, oldest]
    assert all(np.isnan(touch["depth"]) for touch in shown)  # grey pictures tell of no height
    bare.rig._reset.clear(0)
    assert all(np.isnan(channel.tactile.latest()["exposed"]) for channel in channels)


@pytest.mark.parametrize(("link_timeout", "lost"), [(2.0, False), (0.05, True)])
def test_package_gap_beyond_timeout_is_lost_link(link_timeout: float, lost: bool) -> None:
    now = time.monotonic()
    zero = np.zeros(6)
    states = [
        ArmState(Pose(np.array([x, 0.0, 0.0])), zero, zero, zero, now - ago) for x, ago in ((0.0, 0.3), (3e-3, 0.0))
    ]
    asked = (now - 0.1, lambda: states[-1], lambda number: states, "left", link_timeout)
    if lost:
        with pytest.raises(NotAligned, match="was the link lost"):
            await_state_at(*asked)
    else:
        state, gap = await_state_at(*asked)
        assert state.pose.position == pytest.approx([2e-3, 0, 0])
        assert gap == pytest.approx(0.1)


def test_delayed_process_still_reads_state_at_time() -> None:
    """More packages come between the count of those that reach back to a moment and the copy of them."""
    now, zero = time.monotonic(), np.zeros(6)
    kept = [
        ArmState(Pose(np.array([ago, 0.0, 0.0])), zero, zero, zero, now - ago) for ago in np.arange(1.0, 0.0, -2e-3)
    ]

    def history(number: int | None) -> list[ArmState]:
        return kept if number is None else kept[-max(1, number - 100) :]

    state, _ = await_state_at(now - 0.5, lambda: kept[-1], history, "left", 0.05)
    assert state.pose.position[0] == pytest.approx(0.5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stop", "error", "words"),
    [
        ("estop", EmergencyStop, "a person must release it"),
        ("protective_stop", ProtectiveStop, r"made a protective stop; find the cause, then recover\(\)"),
    ],
)
def test_stop_ends_episode_keeps_recording_and_needs_recover(
    shared: Opened, stop: str, error: type[DeviceError], words: str
) -> None:
    upper, lower = shared.rig.arms["right"], shared.rig.arms["left"]
    faults = shared.cell.faults["right"]
    failed = failing(shared.rig, getattr(faults, stop))
    try:
        # Either arm may be asked first: the one that stopped, or the one that stopped because the other did.
        assert isinstance(failed.__cause__, error | SafetyViolation)
        assert len(failed.episode.steps) >= 3
        with pytest.raises(error, match=words):
            upper.command(None)
        until(lambda: _refuses(lower, SafetyViolation), "the other arm's stop")
        with pytest.raises(DeviceError):
            shared.rig.reset()  # nothing starts again by itself
        if stop == "estop":
            with pytest.raises(EmergencyStop, match="must release it"):
                upper.recover()  # type: ignore[attr-defined]
    finally:
        faults.recover()
        upper.recover()  # type: ignore[attr-defined]
        lower.recover()  # type: ignore[attr-defined]
    shared.rig.reset()
    shared.rig.step(Action())


def _refuses(arm: object, error: type[DeviceError]) -> bool:
    try:
        arm.command(None)  # type: ignore[attr-defined]
    except error:
        return True
    return False


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "why"),
    [
        ("stall", ""),
        pytest.param("freeze", "has shown the same picture for", marks=pytest.mark.deep),
        pytest.param("cut", "a damaged picture", marks=pytest.mark.deep),
    ],
)
def test_frozen_or_damaged_camera_ends_episode(shared: Opened, fault: str, why: str) -> None:
    camera = shared.cameras["right"]
    set_fault = getattr(camera, fault)
    try:
        failed = failing(shared.rig, lambda: set_fault(True))
    finally:
        set_fault(False)
    assert isinstance(failed.__cause__, StaleFrame)
    assert "sensor 'right'" in str(failed) and "ms old, limit 1000 ms" in str(failed) and why in str(failed)
    assert len(failed.episode.steps) >= 3
    if why:
        diagnostics = shared.rig.diagnostics()
        assert diagnostics["pictures_repeated_right" if fault == "freeze" else "pictures_damaged_right"] > 0
    shared.rig.reset()


def test_ctrl_c_in_reset_leaves_arms_at_rest(shared: Opened, monkeypatch: pytest.MonkeyPatch) -> None:
    """No request follows; the next reset starts again."""
    waited = robot.rig.reset.wait_for_arrival

    def interrupted(arms: Mapping[str, CommandedArm], timeout: float) -> None:
        os.kill(os.getpid(), signal.SIGINT)  # while they retreat
        waited(arms, timeout)

    monkeypatch.setattr(robot.rig.reset, "wait_for_arrival", interrupted)
    with pytest.raises(KeyboardInterrupt):
        shared.rig.reset()
    monkeypatch.setattr(robot.rig.reset, "wait_for_arrival", waited)
    until(lambda: all(faults.state().rests for faults in shared.cell.faults.values()), "rest")
    shared.rig.reset()


def test_reset_without_confirmation_does_not_approach(shared: Opened) -> None:
    reset = shared.rig._reset
    asked: list[float] = []
    before = reset._confirm  # type: ignore[attr-defined]
    reset._confirm = lambda: bool(asked.append(time.monotonic()))  # type: ignore[attr-defined]
    try:
        with pytest.raises(NotConfirmed, match="no arm approaches"):
            shared.rig.reset()
    finally:
        reset._confirm = before  # type: ignore[attr-defined]
    assert len(asked) == 1
    assert shared.rig.observe().arms["right"].pose.position == pytest.approx([0, 0, 30e-3], abs=50e-6)


@pytest.mark.slow
def test_second_rig_at_same_addresses_is_refused(shared: Opened, tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="in use"):
        open_rig(bare_file(tmp_path))
    shared.rig.reset()  # the first one goes on

"""Rigs of hardware that are refused, closed, or lose a process: nothing may be left of them."""

from __future__ import annotations

import contextlib
import os
import re
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from robot.camera.camera import StaleFrame
from robot.deploy.control_loop import EpisodeFailed
from robot.errors import DeviceError, DeviceNotConnectedError, LinkLost
from robot.open import open_rig
from tacsim.config import load_rig
from tacsim.interface import Action, Pose
from tests.robot.rig.bare_rig import Opened, bare_file, belongings, cameras_of, failing, needs_proc, opened
from tests.robot.waiting import until

pytestmark = pytest.mark.usefixtures("no_pause")
MOTIONS = {1, 2, 3, 4, 6, 9, 10, 11, 12, 18, 24, 25, 41, 45, 51, 52, 66}  # of the library: all that move an arm


@pytest.mark.slow
@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("arms.east.host=192.0.2.1", "its host 192.0.2.1 is outside this machine"),
        ("arms.east.mock=null", "'east' is a real arm, but its host .* is this machine"),
        ("arms.east.start=null", "arms.east.start"),
        ("arms.east.start.position=[3, 0, 0]", "out of reach"),
        ("sensors.east.width=100", "sensor 'east'.*expected 100 x"),
    ],
)
def test_invalid_rig_is_refused_and_leaves_no_process(tmp_path: Path, override: str, words: str) -> None:
    overrides = [override, *["arms.east.watchdog=10"] * override.endswith("mock=null")]
    file = bare_file(tmp_path, first=61)
    with cameras_of(load_rig(file).config):
        before = belongings()
        with pytest.raises((DeviceError, ValueError), match=words):
            open_rig(file, overrides=overrides)
        until(lambda: belongings() == before, "what was started is gone")


@pytest.mark.slow
def test_dry_run_sends_no_motion(tmp_path: Path) -> None:
    with opened(bare_file(tmp_path, first=51), dry_run=True) as dry:
        observation = dry.rig.reset()
        pose = observation.arms["east"].pose
        for _ in range(3):
            observation, sent = dry.rig.step(Action({"east": Pose(pose.position + [0, 0, 1e-3], pose.quaternion)}))
            assert sent == {"west": None, "east": None}
        dry.rig.stop()
        assert observation.arms["east"].pose.position == pytest.approx(pose.position, abs=1e-6)
        received = dry.received()
    for name, commands in received.items():
        assert len(commands) > 3, f"arm '{name}' was not even connected"
        assert not MOTIONS & set(commands)


@pytest.mark.slow
@needs_proc
def test_rig_close_twice_leaves_no_process(tmp_path: Path) -> None:
    file = bare_file(tmp_path, first=53)
    with cameras_of(load_rig(file).config):
        before = belongings()
        rig = open_rig(file)
        there = belongings()
        assert there[0] == before[0] + 3  # two workers and the controllers
        assert there[2] == before[2] + 4  # two memories, each by its own descriptor and by that of its mapping
        rig.close()
        until(lambda: belongings() == before, "all is given back")
    rig.close()
    with pytest.raises(DeviceNotConnectedError, match="closed"):
        rig.arms["east"].command(None)


def one_killed(folder: Path, first: int, victim: Callable[[Opened], int]) -> EpisodeFailed:
    with opened(bare_file(folder, first), link_timeout=6.0) as found:
        failed = failing(found.rig, lambda: os.kill(victim(found), signal.SIGKILL))
        with contextlib.suppress(DeviceError, ExceptionGroup):
            found.rig.stop()
    return failed


@needs_proc
@pytest.mark.deep
@pytest.mark.parametrize(
    ("victim", "errors", "words"),
    [
        (lambda found: found.cell._controllers.pid, (LinkLost, DeviceNotConnectedError, DeviceError), "arm '"),
        (lambda found: found.rig.arms["east"].driver.worker.pid, (DeviceError,), "worker|the other arm did"),
        (lambda found: found.cameras["west"].pid, (StaleFrame,), "sensor 'west'"),
    ],
    ids=["controllers", "worker", "camera"],
)
def test_killed_process_ends_episode_with_message(
    tmp_path: Path, victim: Callable[[Opened], int], errors: tuple[type[Exception], ...], words: str
) -> None:
    before = belongings()
    failed = one_killed(tmp_path, 55, victim)
    assert isinstance(failed.__cause__, errors)
    assert re.search(words, str(failed)), str(failed)
    assert len(failed.episode.steps) >= 3
    until(lambda: belongings() == before, "all is given back")

"""`tacsim reproduce`: what counts as the paper's curves, trials in processes, signals."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from robot.studies.experiment import (
    EXPERIMENTS,
    TrialFailed,
    as_json,
    image_difference,
    key_steps,
    run_trials,
    shortcomings,
)
from tacsim.interface import TactileFrame
from tacsim.report.figure4 import Trial
from tests.robot.cli.invoked import START, environment, tacsim
from tests.robot.waiting import alive, until

pytestmark = pytest.mark.usefixtures("empty_folder")


def made_up(distance: list[float]) -> Trial:
    """A trial with these distances [mm] from the goal."""
    metres = [value * 1e-3 for value in distance]
    seen = [0.5 * k for k in range(len(distance))]
    return Trial(
        list(range(len(distance))), [-d for d in distance], metres, seen, 7e-3, [], 1e-4, (0.02, 0.02, 0.004), 1e-3
    )


def test_reproduce_accepts_only_curve_with_peak_at_goal() -> None:
    good = made_up([3.0, 1.5, 0.04, 1.0, 2.0])
    assert shortcomings("squeeze", good) == []
    assert "closest" in shortcomings("squeeze", made_up([3.0, 1.5, 0.06, 1.0, 2.0]))[0]
    assert shortcomings("reposition", made_up([3.0, 1.5, 0.06, 1.0, 2.0])) == []  # 0.1 mm will do there
    assert "at the end" in shortcomings("squeeze", made_up([3.0, 1.5, 0.04, 0.1, 0.28]))[0]
    assert "at the start" in shortcomings("squeeze", made_up([0.2, 0.1, 0.04, 1.0, 2.0]))[0]
    assert "at the end" in shortcomings("squeeze", made_up([3.0, 2.0, 1.0, 0.5, 0.0]))[0]  # never falls
    blind = replace(good, image_difference=[0.0] * 5)
    assert "images" in shortcomings("squeeze", blind)[0]
    assert shortcomings("squeeze", made_up([float("nan")] * 5))  # nothing is no success


def test_reproduce_prints_result_per_trial() -> None:
    assert key_steps(26, 15) == [0, 7, 15, 20, 25]
    assert key_steps(3, 2) == [0, 1, 2]
    config = as_json({"squeeze": {"seed": made_up([1.0, 0.0, 1.0])}})
    assert set(config["squeeze"]["seed"]) >= {"step", "reward", "goal", "image_difference"}
    json.dumps(config, allow_nan=False)
    dark, bright = (TactileFrame(np.full((2, 2, 3), value, np.uint8), time=0.0, index=0) for value in (250, 10))
    assert image_difference({"a": bright, "b": dark}, {"a": dark, "b": dark}) == 120.0  # no wrap-around of uint8


@pytest.mark.deep
def test_failed_trial_reports_its_error() -> None:
    with pytest.raises(TrialFailed, match=r"squeeze by physics 'magic' failed: KeyError"):
        run_trials([("squeeze", "magic")])


@pytest.mark.deep
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks for the processes in /proc")
@pytest.mark.parametrize(
    ("number", "to_group", "code"),
    [(signal.SIGTERM, False, 143), (signal.SIGHUP, True, 129), (signal.SIGKILL, False, -signal.SIGKILL)],
)
def test_signal_ends_reproduce_and_its_processes(
    tmp_path: Path, number: signal.Signals, to_group: bool, code: int
) -> None:
    words = [*START, "reproduce", "--out", "f"]
    process = subprocess.Popen(words, env=environment(), stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        children = _wait_for_children(process)
        (os.killpg if to_group else os.kill)(process.pid, number)
        _, errors = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == code, errors
    if number != signal.SIGKILL:  # a process that is being started by one that is gone says so in Python's way
        assert "Traceback" not in errors
    assert not (tmp_path / "f").exists()
    until(lambda: not any(map(alive, children)), "its processes have ended")


def _wait_for_children(process: subprocess.Popen[str]) -> list[int]:
    """Process ids of the workers, once there are some."""
    end = time.monotonic() + 60
    while time.monotonic() < end and process.poll() is None:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        if len(children) >= 2:
            return [int(word) for word in children]
        time.sleep(0.1)
    pytest.fail("no processes were started")


@pytest.mark.deep
@pytest.mark.timeout(600)
def test_reproduce_seed_experiment_succeeds(tmp_path: Path) -> None:
    result = tacsim("reproduce", "--out", "f")
    assert result.exit_code == 0, result.output
    config = json.loads((tmp_path / "f" / "fig4.json").read_text())
    for task, planned in EXPERIMENTS.items():
        assert set(config[task]) == {"seed", "hybrid"}
        for curve in config[task].values():
            assert curve["step"] == list(range(len(curve["reward"])))
            assert len(curve["step"]) <= planned.steps + 1
            assert 0.4 < np.argmax(curve["reward"]) / curve["step"][-1] < 0.8
    assert imread(tmp_path / "f" / "fig4.png").shape[1] > 1500

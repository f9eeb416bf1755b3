"""A rig in Rerun while it runs: what is shown, what it costs, and what becomes of the run when the viewer dies."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from importlib import util
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot.export import rerun_view
from robot.export.rerun_view import LiveView
from robot.rig.recorded import observe_episode
from tacsim.interface import Pose, Truth
from tests.robot.cli.invoked import tacsim
from tests.robot.export.made_up import LOADED, record
from tests.tacsim.gym.small import SMALL

needs_rerun = pytest.mark.skipif(util.find_spec("rerun") is None, reason="needs the extra 'viz'")
TRUTH = Truth(7e-3, np.zeros(3), np.zeros((20_000, 3), np.float32), {"lower": Pose()})


pytestmark = pytest.mark.usefixtures("empty_folder")


class NoViewer:
    """In the place of the process: takes nothing until it is told to."""

    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.go = threading.Event()
        made: Any = object.__new__(LiveView)
        made._line, made.left_out, made._ended = rerun_view.queue.Queue(rerun_view.MAX_WAITING_STEPS), 0, False
        made._pipe = made._process = self
        made._thread = threading.Thread(target=made._hand_over, daemon=True)
        made._thread.start()
        self.view: LiveView = made

    def send(self, seen: Any) -> None:
        self.go.wait()
        self.sent.append(seen)

    def join(self, timeout: float) -> None: ...

    def is_alive(self) -> bool:
        return False

    def close(self) -> None: ...


def seen(steps: int = 3) -> Any:
    path, _ = record("a.mcap", steps)
    observed = observe_episode(path)
    steps = [(replace(step, frames=dict(step.frames)), observation, TRUTH) for step, observation in observed.steps()]
    return observed.episode.meta.spec, steps


def test_a_viewer_that_is_too_slow_is_not_waited_for() -> None:
    """One step is on its way, WAITING are in line, all others are left out: nobody waits for any."""
    _, steps = seen()
    stalled = NoViewer()
    stalled.view(*steps[0])
    while not stalled.view._line.empty():  # the first is on its way
        time.sleep(1e-3)
    for k in range(1, 10):
        stalled.view(*steps[k % 3])
    assert stalled.view.left_out == 9 - rerun_view.MAX_WAITING_STEPS and stalled.sent == []
    stalled.go.set()
    stalled.view.close()
    assert [each if each is None else each[0].index for each in stalled.sent] == [0, 1, 2, None]


@pytest.mark.skipif(util.find_spec("rerun") is not None, reason="rerun is here")
def test_without_rerun_it_says_what_to_install() -> None:
    spec, _ = seen(2)
    with pytest.raises(ValueError, match=r"pip install 'tacsim\[viz\]'"):
        LiveView(spec, LOADED.config, None)


def test_a_file_for_the_viewer_has_its_ending() -> None:
    done = tacsim("run", "sim", "--save-view", "live.txt", "--out", "out")
    assert done.exit_code == 2 and "must end in .rrd" in done.stderr and not Path("out").exists()


@needs_rerun
def test_the_file_holds_what_came_and_is_never_written_over() -> None:
    spec, steps = seen()
    file = Path("live.rrd")
    with LiveView(spec, LOADED.config, file) as view:
        for each in steps:
            while view._line.full():  # slowly enough that nothing is left out
                time.sleep(1e-3)
            view(*each)
    assert view.left_out == 0 and not view.ended
    verified = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "verify", str(file)], capture_output=True, text=True
    )
    assert verified.returncode == 0, verified.stderr
    listed = subprocess.run([sys.executable, "-m", "rerun", "rrd", "print", str(file)], capture_output=True, text=True)
    said = listed.stdout + listed.stderr
    assert "/world/body" in said and "/world/upper/gel" in said and "/force/lower/z" in said
    with pytest.raises(FileExistsError):
        LiveView(spec, LOADED.config, file)


@needs_rerun
def test_a_viewer_that_dies_does_not_disturb() -> None:
    spec, steps = seen()
    view = LiveView(spec, LOADED.config, Path("live.rrd"))
    pid = view._process.pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    view._process.join()
    while not view.ended:
        view(*steps[0])
        time.sleep(1e-3)
    for each in steps:
        view(*each)
    view.close()
    assert not Path("live.rrd").exists()


@pytest.mark.parametrize("share", [0.0, 1e-4, 0.1, 0.5, 0.9])
def test_a_message_cut_short_is_the_end(tmp_path: Path, share: float) -> None:
    _, steps = seen()
    path = tmp_path / "sent"
    with Connection(os.open(path, os.O_WRONLY | os.O_CREAT)) as line:
        line.send(steps[0])
    with Connection(os.open(path, os.O_RDONLY)) as line:
        assert rerun_view._receive(line) is not None
    os.truncate(path, int(share * path.stat().st_size))
    with Connection(os.open(path, os.O_RDONLY)) as line:
        assert rerun_view._receive(line) is None


@needs_rerun
def test_a_file_is_whole_when_the_program_is_killed(tmp_path: Path) -> None:
    program = """
import os, signal, sys, time
from pathlib import Path
from tests.robot.export.test_rerun_live import LOADED, LiveView, seen
if __name__ == "__main__":
    spec, steps = seen()
    view = LiveView(spec, LOADED.config, Path("live.rrd"))
    view(*steps[0])
    while not view._line.empty():
        time.sleep(1e-3)
    os.kill(os.getpid(), signal.SIGKILL)
"""
    Path("program.py").write_text(program)
    path = os.pathsep.join([str(Path(__file__).resolve().parents[3]), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run([sys.executable, "program.py"], env={**os.environ, "PYTHONPATH": path}, timeout=100)
    assert done.returncode == -signal.SIGKILL
    deadline = time.monotonic() + 60.0
    while not Path("live.rrd").exists():
        assert time.monotonic() < deadline, "the viewer's process outlived the program, or left nothing"
        time.sleep(0.05)
    command = [sys.executable, "-m", "rerun", "rrd", "verify", "live.rrd"]
    assert subprocess.run(command, capture_output=True, timeout=60).returncode == 0


@needs_rerun
def test_a_run_is_looked_at_while_it_runs() -> None:
    sets = [word for each in SMALL for word in ("--set", each)]
    words = ["run", "sim", "--task", "squeeze", *sets, "--steps", "2", "--save-view", "live.rrd"]
    done = tacsim(*words, "--out", "out")
    assert done.exit_code == 0, done.output
    command = [sys.executable, "-m", "rerun", "rrd", "print", "live.rrd"]
    listed = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert "/world/body" in listed.stdout + listed.stderr
    again = tacsim(*words, "--out", "again")
    assert again.exit_code != 0 and "live.rrd: exists already" in again.stderr and not Path("again").exists()

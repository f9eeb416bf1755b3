"""The process of `lerobot-record` is killed while an arm moves: the arm stands soon, and stays."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from robot.mock import FaultClient
from tests.plugins.commands import surroundings, words_of
from tests.robot.cli.lab import Lab, copy_of
from tests.robot.waiting import until
from tests.stops.observer import PACKAGE
from tests.stops.watched import SETTLES, outcome

OBSERVER = Path(__file__).parents[1] / "stops" / "observer.py"
MOVES = 8e-3  # faster than that it is on its way [m/s]


@pytest.mark.deep
@pytest.mark.timeout(280)
def test_an_arm_stands_soon_after_its_recording_was_killed(tmp_path: Path) -> None:
    rig = copy_of("ur5e-one", tmp_path, 71)
    options = [
        *("--robot.type=tacsim", f"--robot.rig={rig}", "--teleop.type=tacsim", f"--teleop.rig={rig}"),
        *("--teleop.device=script", "--teleop.step=0.002", "--dataset.single_task=stroke", "--dataset.fps=10"),
        *("--dataset.repo_id=me/set", f"--dataset.root={tmp_path / 'set'}", "--dataset.push_to_hub=false"),
        *("--dataset.video=false", "--play_sounds=false", "--dataset.episode_time_s=60"),
    ]
    script = surroundings(tmp_path) | {"SCRIPTED_STROKES": "1,0,0"}
    said: list[bytes] = []
    with Lab(rig) as lab:
        faults = lab.faults["arm"]
        host = lab.config.arms["arm"].host  # type: ignore[union-attr]
        watcher = [sys.executable, str(OBSERVER), host, str(tmp_path / "seen.npy")]
        with subprocess.Popen(watcher, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as observer:
            own, inner = os.openpty()
            recorder = subprocess.Popen(
                words_of("lerobot-record", *options),
                stdin=inner, stdout=inner, stderr=inner, cwd=tmp_path, env=script, start_new_session=True,
            )  # fmt: skip
            os.close(inner)
            reader = threading.Thread(target=_read, args=(own, said))
            reader.start()
            try:
                until(lambda: b"[y/N]" in b"".join(said) or recorder.poll() is not None, "question", pause=0.05)
                assert recorder.poll() is None, b"".join(said)[-3000:].decode()
                os.write(own, b"y\n")
                until(
                    lambda: b"Recording episode" in b"".join(said) or recorder.poll() is not None, "start", pause=0.02
                )
                until(
                    lambda: np.linalg.norm(faults.state().tcp_speed[:3]) > MOVES, "motion", why=lambda: str(said[-5:])
                )
                recorder.send_signal(signal.SIGKILL)
                event = time.monotonic()
                until(lambda: faults.state().rests, "rest", pause=0.05)
                end = faults.state().tick + 500  # a second more
                until(lambda: faults.state().tick >= end, "end of the watch", pause=0.05)
            finally:
                recorder.kill()
                recorder.wait()
                reader.join()
            assert observer.stdin is not None
            observer.stdin.close()
            assert observer.wait(60.0) == 0
    packages = np.load(tmp_path / "seen.npy")
    assert packages.dtype == PACKAGE
    found = outcome(packages, event, [])
    print(f"still after {1e3 * found.still:.0f} ms, on a path of {1e3 * found.path:.2f} mm")
    assert found.moved <= SETTLES and found.ended is not None, found


def speed(faults: FaultClient) -> float:
    """Of the tool [m/s]."""
    return float(np.linalg.norm(faults.state().tcp_speed[:3]))


def _read(terminal: int, said: list[bytes]) -> None:
    with contextlib.suppress(OSError):  # nobody holds the other end any more
        while data := os.read(terminal, 65536):
            said.append(data)
    os.close(terminal)

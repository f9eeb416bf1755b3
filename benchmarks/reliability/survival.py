"""Reliability cases of what dies, ends, or comes back: policies, workers, cameras, and what they leave behind."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.harness.measure import Measurement
from benchmarks.reliability.rehearsal import (
    PATIENCE,
    config,
    driven,
    host,
    mock_arm,
    moved,
    segments,
    shift,
    still,
    under_way,
    until,
    workers,
)
from benchmarks.reliability.repeated import COUNT, Disturbed, Figure, repeated
from robot.arm import shared_ring
from robot.arm.channel import ArmStatus
from robot.camera.camera import Camera, StaleFrame
from robot.mock import MockCamera, MockState, MockUR
from tacsim.models.hardware import CameraSensorConfig

FPS, MAX_AGE = 30.0, 0.2  # of the camera [Hz, s]
POLICY = """
import sys, time
from benchmarks.reliability.rehearsal import moved, under_way
from robot.arm.ur import URArm
from tacsim.models.hardware import UrArmFacts
arm = URArm(UrArmFacts.model_validate_json(sys.argv[1]), "policy")
under_way(arm, moved(arm.state().pose, x=0.14))
print("under way", flush=True)
time.sleep(60)
"""


def _rest(mock: MockUR) -> tuple[float, MockState]:
    """When the tool of a mock stood [s], and the mock once nothing in it moves any more."""
    stood = until(lambda: still(mock.faults.state()), "standstill", pause=5e-4)
    until(lambda: mock.faults.state().rests, "rest")
    return stood, mock.faults.state()


def _clients(mock: MockUR) -> int:
    """Connections to a mock, without those of its fault client."""
    return sum(port != mock.fault_clients[0].port for port in mock.faults.state().clients)


def _gone(number: int) -> bool:
    """True if there is no such process, or only its exit status is left."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def policy_death(repeat: int) -> list[Measurement]:
    """SIGKILL to the process of a policy that drives the arm at 0.1 m/s; nobody is left to clean up."""

    def once() -> dict[str, float]:
        mock.faults.reset()
        words = [sys.executable, "-c", POLICY, config(mock.host, watchdog=10.0).model_dump_json()]
        root = str(Path(shared_ring.__file__).resolve().parents[2])
        path = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))
        with subprocess.Popen(words, stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": path}) as policy:
            assert policy.stdout is not None
            try:
                if policy.stdout.readline() != b"under way\n":
                    raise Disturbed("the policy that was to be killed did not come under way")
                (worker,) = workers(policy.pid)
                before = mock.faults.state()
            finally:
                killed = time.monotonic()
                policy.kill()
            stood, after = _rest(mock)
        with contextlib.suppress(TimeoutError):
            until(lambda: _gone(worker) and not segments(policy.pid) and not _clients(mock), "nothing left")
        return {
            "still": 1e3 * (stood - killed),
            "way": 1e3 * shift(before, after),
            "left": float(not _gone(worker)) + segments(policy.pid) + _clients(mock),
        }

    with mock_arm() as mock:
        return repeated(
            repeat,
            once,
            [
                Figure("still", "ms", "the signal; slower than 1 mm/s"),
                Figure("way", "mm", "the tool just before the signal"),
                Figure("left", COUNT, f"processes, sockets, shared memory, at the latest {PATIENCE:g} s after"),
            ],
        )


def worker_death(repeat: int) -> list[Measurement]:
    """SIGKILL to the worker of an arm at 0.1 m/s: the controller's watchdog is left, and the driver."""

    def once() -> dict[str, float]:
        with driven(mock, config(mock.host, watchdog=10.0)) as (arm, _):
            under_way(arm, moved(arm.state().pose, x=0.14))
            (worker,) = workers(os.getpid())
            os.kill(worker, signal.SIGKILL)
            killed = time.monotonic()
            stood, _ = _rest(mock)
            until(lambda: arm.status() == ArmStatus.WORKER_DEAD, "death")
            asked = time.monotonic()
            arm.recover()
            ready = time.monotonic()
            sound = arm.status() == ArmStatus.HOLD
        if not sound:
            raise RuntimeError("the new worker does not hold the arm")
        return {"still": 1e3 * (stood - killed), "new worker": ready - asked}

    with mock_arm() as mock:
        return repeated(
            repeat,
            once,
            [
                Figure("still", "ms", "the signal; slower than 1 mm/s; watchdog 10 Hz"),
                Figure("new worker", "s", "recover(), until it returns"),
            ],
        )


def shutdown(repeat: int) -> list[Measurement]:
    """close() of an arm that is under way."""

    def once() -> dict[str, float]:
        with mock_arm() as mock, driven(mock) as (arm, watcher):
            under_way(arm, moved(arm.state().pose, x=0.12))
            watcher.__exit__(None, None, None)
            mine = workers(os.getpid())
            asked = time.monotonic()
            arm.close()
            ended = time.monotonic()
            arm.close()  # twice does no harm
            with contextlib.suppress(TimeoutError):
                until(lambda: not _clients(mock), "closed sockets")
            left = sum(not _gone(worker) for worker in mine) + segments(os.getpid()) + _clients(mock)
        return {"close": ended - asked, "left": float(left)}

    return repeated(
        repeat,
        once,
        [
            Figure("close", "s", "the call, under way at 0.1 m/s"),
            Figure("left", COUNT, "processes, sockets, shared memory"),
        ],
    )


def camera(repeat: int) -> list[Measurement]:
    """A camera whose consumer pauses, that stalls, that is killed and started again."""

    def once() -> dict[str, float]:
        with MockCamera(host=host(3), fps=FPS) as mock:
            given = CameraSensorConfig(
                driver="camera", source=mock.url, width=320, height=240, fps=FPS, stamped=True, max_age=MAX_AGE
            )
            with Camera(given, "bench") as camera:
                ages = []
                for _ in range(3):
                    time.sleep(0.25)
                    ages.append(time.monotonic() - camera.read(1.0).time)
                stale = _stalled(mock, camera)
                mock.stall(False)
                last = camera.read(PATIENCE).index
                os.kill(mock.pid, signal.SIGKILL)
                until(lambda: not camera.status.open, "end of the stream")
                time.sleep(0.3)
                with MockCamera(host=host(3), port=mock.port, fps=FPS):
                    back = time.monotonic()
                    again = until(lambda: _index(camera) > last, "a new frame")
        return {"age": 1e3 * float(np.median(ages)), "stale": float(stale), "back": again - back}

    return repeated(
        repeat,
        once,
        [
            Figure("age", "ms", "exposure, by the stamp; a consumer that pauses for 0.25 s"),
            Figure("stale", COUNT, "frames delivered in a stall beyond max_age, or as new without a newer exposure"),
            Figure("back", "s", "the camera serves again, until a new frame is delivered"),
        ],
    )


def _index(camera: Camera) -> int:
    try:
        return camera.read(0.0).index
    except StaleFrame:
        return -1


def _stalled(mock: MockCamera, camera: Camera) -> int:
    """Stalls a camera and reads for twice max_age; how many frames were not what they were taken for."""
    mock.stall(True)
    wrong, seen = 0, camera.read(1.0)
    end = time.monotonic() + 2 * MAX_AGE
    while time.monotonic() < end:
        asked = time.monotonic()
        try:
            frame = camera.read(0.0)
        except StaleFrame:
            time.sleep(2e-3)
            continue
        wrong += asked - frame.time > MAX_AGE
        wrong += frame.index > seen.index and frame.time <= seen.time
        seen = frame
        time.sleep(2e-3)
    return wrong

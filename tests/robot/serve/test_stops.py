"""Each STOP brakes a moving arm, while pictures stream: seen by an observer at the controller, in another process."""

from __future__ import annotations

import json
import random
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from robot.fixtures import mock_host
from tests.promises import Record
from tests.robot.serve.served import REAL_TIME, Page, Served
from tests.robot.serve.test_serve import drive
from tests.stops import observer

CRUISE = 1.5e-3  # limits.speed of the arm, at which it moves all the time while it is jogged [m/s]
MOVING = 0.2 * CRUISE  # a slower arm does not move when STOP comes [m/s]
BRAKING = 0.75  # of its speed at STOP: the arm has begun to brake when it is slower for good
SLACK = 10e-6  # a standing arm moves by less [m]
MAX_GAP = 0.1  # between two packages, beyond which nothing can be said of a STOP [s]
QUIET = 0.25  # after it has come to rest, a motion that goes on is looked for so long [s]
FEW, MANY = 20, 1000  # stops of the two tests


@contextmanager
def observing(host: str, file: Path) -> Iterator[None]:
    """An observer writes what the controller sends to `file`."""
    command = [sys.executable, observer.__file__, host, str(file)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdin is not None
        assert process.stdout.readline() == "ready\n"
        yield
        process.stdin.close()
        process.wait(60.0)


def stop_often(served: Served, page: Page, count: int) -> list[tuple[float, float]]:
    """Moves the upper arm up and down by hand and stops it `count` times. Returns when each STOP was sent, and until
    when nothing was started after it [s]."""
    asked = []
    draw = random.Random(1)
    for number in range(count):
        drive(served, page)
        before = page.view["arms"]["upper"]["position"][2]
        page.jog = ("upper", [0.0, 0.0, 1.0 if before > 30e-3 else -1.0, 0.0, 0.0, 0.0])
        page.until(lambda view, before=before: abs(view["arms"]["upper"]["position"][2] - before) > 0.2e-3)  # type: ignore[misc]
        time.sleep(draw.uniform(0.0, 0.1))
        moment = time.monotonic()
        assert served.ask("POST", "/stop", token="")[0] == 200
        assert "STOP was pressed" in page.until_rest()["words"], number  # the jog goes on: it must move nothing
        time.sleep(QUIET)
        page.jog = None
        asked.append((moment, time.monotonic()))
    return asked


@dataclass
class Judged:
    """What an observer saw of many STOPs."""

    latencies: list[float] = field(default_factory=list)  # from a STOP to the first package of the deceleration [s]
    lost: list[str] = field(default_factory=list)  # the arm has not come to rest, or has moved on: what was seen
    standing: int = 0  # STOPs that came while the arm did not move
    unseen: int = 0  # STOPs after which the controller or the observer stalled


def judge(seen: NDArray[np.void], asked: list[tuple[float, float]]) -> Judged:
    times, speeds = seen["received"], np.linalg.norm(seen["velocity"], axis=1)
    found = Judged()
    for number, (moment, quiet) in enumerate(asked):
        start, end = np.searchsorted(times, [moment, quiet])
        gap = float(np.diff(times[start - 1 : end], append=quiet).max())
        if gap > MAX_GAP:
            found.unseen += 1
            continue
        distances = np.linalg.norm(seen["position"][start:end] - seen["position"][end - 1], axis=1)
        moving = np.flatnonzero(distances > SLACK)
        rest = start + int(moving[-1]) + 1 if len(moving) else start
        if times[end - 1] - times[min(rest, end - 1)] < 0.5 * QUIET:
            steps = [f"{1e3 * (t - moment):.0f} ms: {1e3 * v:.2f} mm/s" for t, v in
                     zip(times[start:end:5], speeds[start:end:5], strict=True)]  # fmt: skip
            found.lost.append(f"STOP {number}, moved {1e3 * distances[0]:.3f} mm in {quiet - moment:.3f} s: {steps}")
            continue
        speed = float(np.median(speeds[max(0, start - 10) : start]))
        if speed < MOVING:
            found.standing += 1
            continue
        fast = np.flatnonzero(speeds[start:rest] > BRAKING * speed)
        found.latencies.append(float(times[start + int(fast[-1]) + 1] - moment) if len(fast) else 0.0)
    return found


def stop_and_judge(folder: Path, count: int, record: object) -> Judged:
    limit = f"arms.upper.limits.speed={CRUISE}"
    file = folder / "seen.npy"
    with Served(folder, "mock", *REAL_TIME, "--set", limit) as served, Page(served) as page:
        page.until_rest()
        views = threading.active_count()
        with observing(mock_host(12), file):
            asked = stop_often(served, page, count)
            time.sleep(0.5)
        assert threading.active_count() == views and len(page.pictures) >= 2
    np.save(folder / "asked.npy", asked)
    found = judge(np.load(file), asked)
    milliseconds = sorted(1e3 * each for each in found.latencies)
    p99 = milliseconds[min(len(milliseconds) - 1, round(0.99 * len(milliseconds)))]
    figures = {
        "stops": count, "lost": len(found.lost), "not moving": found.standing, "unseen": found.unseen,
        "median_ms": round(statistics.median(milliseconds), 1), "p99_ms": round(p99, 1),
        "max_ms": round(milliseconds[-1], 1),
    }  # fmt: skip
    record("stop_latency", json.dumps(figures))  # type: ignore[operator]
    sys.stdout.write(
        "\n".join(["", f"STOP, from the request to the deceleration at the controller: {figures}", *found.lost])
    )
    return found


@pytest.mark.slow
@pytest.mark.promise(16)
def test_no_stop_is_lost(tmp_path: Path, record_property: object, figure: Record) -> None:
    found = stop_and_judge(tmp_path, FEW, record_property)
    for latency in found.latencies:
        figure(
            f"STOP while pictures stream, to the deceleration ({FEW} a repetition)", 1e3 * latency, "ms", at_most=100.0
        )
    figure("STOPs that did not bring the arm to rest", len(found.lost))
    assert not found.lost and len(found.latencies) > FEW / 2
    assert max(found.latencies) < 1.0  # 100 ms is promised of a machine that nobody else uses


@pytest.mark.promise(16)
@pytest.mark.deep
@pytest.mark.timeout(5400)
def test_no_stop_of_many_is_lost(tmp_path: Path, record_property: object) -> None:
    """Prints its figures: `pytest -m deep -s tests/robot/serve/test_stops.py`, on an idle machine."""
    found = stop_and_judge(tmp_path, MANY, record_property)
    assert not found.lost and len(found.latencies) > MANY / 2
    assert statistics.median(found.latencies) < 0.1

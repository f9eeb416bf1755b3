"""While another program drives the arm the driver reports it at once, sends nothing, and goes on only by recover()."""

from __future__ import annotations

import socket
import time

import numpy as np
import pytest

from robot.mock import FaultClient
from tests.promises import Record
from tests.robot.waiting import PATIENCE, until
from tests.stops.watched import Trial, stamps_since

SECONDS = 10.0  # that the other program runs
MOVES = 1e-3  # the tool moves that is faster [m/s]


def start_script(faults: FaultClient, *, moves_first: bool) -> float:
    """Sends a script of SECONDS that turns the base joint by 0.4 rad; returns when, monotonic clock [s]."""
    joints = np.array(faults.state().joints)
    goal = (joints + [0.4, 0.0, 0.0, 0.0, 0.0, 0.0]).tolist()
    wait = "" if moves_first else "  sleep(0.5)\n"
    left = SECONDS - 4.0 - (not moves_first) * 0.5
    with socket.create_connection((faults.host, 30003), timeout=PATIENCE) as script:
        now = time.monotonic()
        script.sendall(f"def other():\n{wait}  movej({goal}, a=1.0, v=0.1)\n  sleep({left})\nend\n".encode())
        time.sleep(0.04)
    return now


@pytest.mark.slow
@pytest.mark.promise(7)
@pytest.mark.parametrize(
    "moves_first",
    [pytest.param(True, id="moves at once"), pytest.param(False, id="moves after 0.5 s", marks=pytest.mark.deep)],
)
def test_while_another_program_drives_the_arm_it_is_reported(
    trial: Trial, measuring: bool, moves_first: bool, figure: Record
) -> None:
    event = start_script(trial.mock.faults, moves_first=moves_first)

    def has_ended() -> bool:  # on a busy machine later than after SECONDS: the mock's time lags behind the clock
        return time.monotonic() > event + SECONDS and not trial.mock.faults.state().program

    ended = until(has_ended, "end of the other program", pause=0.05)
    trial.watch_until(lambda: time.monotonic() > ended + 1.0)
    said, seen = trial.reports(event), trial.seen()
    assert said, "nothing was reported"
    since = stamps_since(seen, event)
    speed = np.linalg.norm(seen["velocity"], axis=1)
    log = trial.mock.faults.log()
    (began,) = [when for when, text in log if "'other' started" in text]
    first = int(np.argmax((seen["timestamp"] >= began) & (speed > MOVES)))  # of the other program's motion
    reported = said[0]["time"] - event
    name = "another program's script, 10 s" + ("" if moves_first else ", moves after 0.5 s")
    late = max(0.0, reported - float(since[first]))  # 0: before that, by the state of the program
    figure(f"{name}: reported after its first motion", 1e3 * late, "ms", at_most=20.0)
    figure(f"{name}: reported after it was sent", 1e3 * reported, "ms", at_most=None)
    assert reported < 1.0  # however busy the machine is: not when that program ends
    assert not measuring or late <= 20e-3
    # A worker that a busy machine has stalled may see first that the arm is not where it was sent.
    by_name = [each for each in said if measuring or each["status"] != "NOT_FOLLOWING"]
    assert by_name and by_name[0]["status"] in ("PROGRAM_STOPPED", "OTHER_PROGRAM"), said
    assert by_name[0]["time"] - event < 1.0  # what comes later may be of a busy machine, too
    assert not trial.mock.faults.state().program
    moved = np.linalg.norm(seen["position"][-1] - seen["position"][first])
    assert moved > 0.1, log  # the other program was not disturbed
    quiet = seen["received"] > ended + 0.2
    assert speed[quiet].max() < MOVES  # and nothing moves after it

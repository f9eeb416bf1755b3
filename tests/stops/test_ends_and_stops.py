"""An arm that stands after a process was ended, or after its controller stopped it, does not move again by itself.

Each event meets an arm at 0.1 m/s; an observer of its own process watches it for a while after its first standstill.
"""

from __future__ import annotations

import signal
import socket
import time
from collections.abc import Callable

import pytest

from robot.mock import FaultClient
from tests.promises import Record
from tests.robot.waiting import PATIENCE
from tests.stops.watched import Trial, judge


def to_all(trial: Trial, number: signal.Signals) -> float:
    """As `systemctl stop` does, or the end of a session."""
    event = trial.signal(trial.worker, number)
    trial.signal(trial.policy.pid, number, group=True)
    return event


ENDS: dict[str, Callable[[Trial], float]] = {
    "policy killed (SIGKILL)": lambda trial: trial.signal(trial.policy.pid, signal.SIGKILL),
    "policy hung (SIGSTOP)": lambda trial: trial.signal(trial.policy.pid, signal.SIGSTOP),
    "Ctrl-C": lambda trial: trial.signal(trial.policy.pid, signal.SIGINT, group=True),
    "SIGHUP to the group": lambda trial: trial.signal(trial.policy.pid, signal.SIGHUP, group=True),
    "SIGTERM to the group": lambda trial: trial.signal(trial.policy.pid, signal.SIGTERM, group=True),
    "SIGTERM to every process": lambda trial: to_all(trial, signal.SIGTERM),
    "worker killed (SIGKILL)": lambda trial: trial.signal(trial.worker, signal.SIGKILL),
    "worker hung (SIGSTOP)": lambda trial: trial.signal(trial.worker, signal.SIGSTOP),
}


@pytest.mark.deep
@pytest.mark.often
@pytest.mark.promise(6)
@pytest.mark.parametrize("name", ENDS)
def test_after_a_process_is_gone_nothing_moves_again(trial: Trial, name: str, watch: float, figure: Record) -> None:
    seen = trial.watch(ENDS[name](trial), watch)
    judge(name, seen, figure, goes_on=name.startswith("policy hung"))


STOPS: dict[str, Callable[[FaultClient], None]] = {
    "protective stop": lambda faults: faults.protective_stop(),
    "emergency stop": lambda faults: faults.estop(),
    "safeguard stop, closed after 40 ms": lambda faults: blink(faults),
    "stop on the pendant": lambda faults: pendant(faults, "stop"),
    "pause on the pendant, play after 40 ms": lambda faults: pendant(faults, "pause", "play"),
}


def blink(faults: FaultClient) -> None:
    faults.safeguard_stop(True)
    time.sleep(0.04)
    faults.safeguard_stop(False)


def pendant(faults: FaultClient, *words: str) -> None:
    with socket.create_connection((faults.host, 29999), timeout=PATIENCE) as dashboard:
        dashboard.recv(1024)  # its greeting
        for word in words:
            dashboard.sendall(word.encode() + b"\n")
            assert dashboard.recv(1024)
            time.sleep(0.04)


@pytest.mark.deep
@pytest.mark.often
@pytest.mark.promise(7)
@pytest.mark.parametrize("name", STOPS)
def test_after_a_stop_of_the_controller_nothing_moves_again(
    trial: Trial, name: str, watch: float, figure: Record
) -> None:
    event = time.monotonic()
    STOPS[name](trial.mock.faults)
    judge(name, trial.watch(event, watch), figure)

"""Why a driver no longer receives from its arm (first cause and words), and the log of the packages that it received.

A link that is cut may crash ur_rtde 1.6.5: its threads close the same connection at once, and the worker is gone before
it can publish what happened. The library always reports the lost connection on standard error first, so that tells a
lost link from a worker that died of something else.
"""

from __future__ import annotations

import signal
from collections.abc import Callable

import numpy as np

from robot.arm.channel import WINDOW
from robot.arm.shared_ring import Record, Ring
from robot.arm.status import ArmStatus, status_of
from robot.arm.trajectory import PERIOD
from robot.common.process import Child
from tacsim.models.hardware import UrArmConfig
from tacsim.record.episode import ArmPackages

OUTLIVED = -signal.SIGALRM  # exit status of a worker whose call into the library outlived its time limit
LIBRARY_REPORTS = (  # ur_rtde 1.6.5, after each failure of a connection and before it touches that connection again
    "Lost connection to robot",
    "Could not receive data from robot",
    "Robot closed the connection",
)


class Verdict:
    """What an arm is doing, by the records and the end of one worker. The first cause of an end is kept. `patience`:
    a link is lost once its newest package is older [s]."""

    def __init__(self, patience: float) -> None:
        self._patience = patience
        self._lost = False  # the link, when it was asked last
        self._final: ArmStatus | None = None  # once the worker has ended

    def status(self, worker: Child | None, latest: Callable[[], Record | None]) -> ArmStatus:
        """`latest` gives the newest record; never raises."""
        if self._final is not None:
            return self._final
        ended = 0 if worker is None else worker.exit_status
        lost = self._lost
        if worker is not None and ended is not None and not lost:
            lost = died_of_lost_link(ended, worker.printed)
        status = status_of(latest(), ended, self._patience, lost=lost)  # read now: nothing is written after the end
        self._lost = status == ArmStatus.LINK_LOST
        if worker is not None and ended is not None:
            self._final = status
        return status


def died_of_lost_link(exit_status: int, printed: str) -> bool:
    """True if a worker that ended without a word lost its link first; `printed` is its standard error."""
    return exit_status == OUTLIVED or any(report in printed for report in LIBRARY_REPORTS)


def explain_lost_link(record: Record, config: UrArmConfig, exit_status: int | None, now: float) -> str:
    """What was measured when the link was lost, and what to do; exit_status: of the worker, None while it runs."""
    max_late_period = 0.5  # of link_timeout: the longest period of a punctual worker
    max_late_share = 0.02  # of the last periods of a punctual worker
    lost = now if exit_status is None else float(record["written"])
    age, unheard = lost - float(record["time"]), lost - float(record["written"])
    text = f"its last package is {1e3 * age:.0f} ms old (link_timeout = {1e3 * config.link_timeout:g} ms)"
    if exit_status == OUTLIVED:
        text += ", a command took longer than link_timeout"
    elif exit_status is not None and age < config.link_timeout:
        text += ", the connection was closed or reset"
    late, count = int(record["late"]), max(1, min(int(record["cycles"]), WINDOW))
    longest = max(float(record["longest"]), unheard)
    periods = f"{late} of its last {count} periods of {1e3 * PERIOD:g} ms were late, the longest {1e3 * longest:.0f} ms"
    if late <= max_late_share * count and longest <= max_late_period * config.link_timeout:
        where = "check the cable" if config.mock is None else "see whether its mock controller still runs"
        return f"{text}; its worker was punctual ({periods}); {where}"
    if bool(record["realtime"]):
        priority, advice = "with real-time priority", "give this machine less to do"
    elif config.mock is not None:
        priority, advice = "without real-time priority", "give this machine less to do, or say `mock: {realtime: true}`"
    else:
        priority = "real-time priority was not given"
        advice = "allow it (`tacsim doctor` says how) or give this machine less to do"
    return f"{text}; its worker was late itself ({periods}; {priority}); {advice}"


class PackageLog:
    """The packages since the last look, each once, and all of them if somebody looks every two seconds. What is
    missing, here or on the way from the controller, shows in the controller's time stamps and is counted.

    states: the worker's records, one a package, and another of the same one when a fault is found in it.
    """

    def __init__(self, states: Ring) -> None:
        self._states = states
        self._read = states.count
        self._time = -np.inf  # of the last package, when it was read [s]
        self._stamp = np.nan  # on the controller's clock [s]

    def take(self) -> ArmPackages:
        """The packages since the last call, or since this log was made."""
        self._read, records = self._states.since(self._read)
        records = records[records["stamp"] != 0.0]  # before its first package a worker has none to tell
        records = records[np.diff(records["time"], prepend=self._time) > 0.0]
        lost = 0
        if len(records):
            gaps = np.diff(records["stamp"], prepend=self._stamp)[0 if np.isfinite(self._stamp) else 1 :]
            lost = int(np.maximum(np.round(gaps / PERIOD) - 1.0, 0.0).sum())  # a controller that restarts counts anew
            self._time, self._stamp = float(records["time"][-1]), float(records["stamp"][-1])
        return ArmPackages.of(records, lost)

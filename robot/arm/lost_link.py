"""The first cause of a lost link with its explanation, and the log of the packages of an arm's controller.

A cut link may crash ur_rtde 1.6.5: its threads close the same connection at the same time, and the worker ends before
it can publish its status. The library always reports the lost connection on standard error first. That report separates
a lost link from a worker that ended for another reason.
"""

from __future__ import annotations

import signal
from collections.abc import Callable

import numpy as np

from robot.arm.channel import STATISTICS_PERIODS
from robot.arm.shared_ring import Record, Ring
from robot.arm.status import ArmStatus, status_of
from robot.arm.trajectory import PERIOD
from robot.common.process import Child
from tacsim.models.hardware import UrArmConfig
from tacsim.record.episode import ArmPackages

TIME_LIMIT_EXIT_STATUS = -signal.SIGALRM  # exit status of a worker whose call into the library exceeded its time limit
LOST_LINK_REPORTS = (  # by ur_rtde 1.6.5, after each failure of a connection and before it uses that connection again
    "Lost connection to robot",
    "Could not receive data from robot",
    "Robot closed the connection",
)


class StatusHistory:
    """Status of an arm, from the records and the exit of one worker. The first cause of an exit is kept. A link is lost
    when its newest package is older than `timeout` [s]."""

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._is_link_lost = False  # at the last call of `status`
        self._final_status: ArmStatus | None = None  # after the worker has ended

    def status(self, worker: Child | None, latest: Callable[[], Record | None]) -> ArmStatus:
        """Present status; `latest` returns the newest record. Never raises."""
        if self._final_status is not None:
            return self._final_status
        ended = 0 if worker is None else worker.exit_status
        is_lost = self._is_link_lost
        if worker is not None and ended is not None and not is_lost:
            is_lost = ended_by_lost_link(ended, worker.printed)
        status = status_of(
            latest(), ended, self._timeout, is_link_lost=is_lost
        )  # read last: nothing is written after the exit
        self._is_link_lost = status == ArmStatus.LINK_LOST
        if worker is not None and ended is not None:
            self._final_status = status
        return status


def ended_by_lost_link(exit_status: int, printed: str) -> bool:
    """True if a worker that ended without a report lost its link first; `printed` is its standard error."""
    return exit_status == TIME_LIMIT_EXIT_STATUS or any(report in printed for report in LOST_LINK_REPORTS)


def describe_lost_link(record: Record, config: UrArmConfig, exit_status: int | None, now: float) -> str:
    """Measured timing at the loss of the link, and what to do. `exit_status` of the worker: None while it runs."""
    max_late_period = 0.5  # longest period of a punctual worker, as a fraction of link_timeout
    max_late_share = 0.02  # fraction of late periods of a punctual worker
    is_lost = now if exit_status is None else float(record["written"])
    age, record_age = is_lost - float(record["time"]), is_lost - float(record["written"])
    text = f"its last package is {1e3 * age:.0f} ms old (link_timeout = {1e3 * config.link_timeout:g} ms)"
    if exit_status == TIME_LIMIT_EXIT_STATUS:
        text += ", a command took longer than link_timeout"
    elif exit_status is not None and age < config.link_timeout:
        text += ", the connection was closed or reset"
    late, count = int(record["late"]), max(1, min(int(record["cycles"]), STATISTICS_PERIODS))
    longest = max(float(record["longest"]), record_age)
    periods = f"{late} of its last {count} periods of {1e3 * PERIOD:g} ms were late, the longest {1e3 * longest:.0f} ms"
    if late <= max_late_share * count and longest <= max_late_period * config.link_timeout:
        where = "check the cable" if config.mock is None else "see whether its mock controller still runs"
        return f"{text}; its worker was punctual ({periods}); {where}"
    if bool(record["realtime"]):
        priority, advice = "with real-time priority", "reduce the load of this machine"
    elif config.mock is not None:
        priority, advice = (
            "without real-time priority",
            "reduce the load of this machine, or set `mock: {realtime: true}`",
        )
    else:
        priority = "real-time priority was not given"
        advice = "allow it (`tacsim doctor` says how) or reduce the load of this machine"
    return f"{text}; its worker itself was late ({periods}; {priority}); {advice}"


class PackageLog:
    """The packages since the last call, each once; complete if `take` is called at least every two seconds. Lost
    packages, here or between controller and worker, are counted by gaps in the controller's time stamps.

    states: records of the worker: one per package, and a second one of a package in which a fault is found.
    """

    def __init__(self, states: Ring) -> None:
        self._states = states
        self._last_number = states.count
        self._last_time = -np.inf  # of the last package, when it was read [s]
        self._last_stamp = np.nan  # on the controller's clock [s]

    def take(self) -> ArmPackages:
        """The packages since the last call, or since the log was created."""
        self._last_number, records = self._states.since(self._last_number)
        records = records[records["stamp"] != 0.0]  # records from before the first package
        records = records[np.diff(records["time"], prepend=self._last_time) > 0.0]
        is_lost = 0
        if len(records):
            gaps = np.diff(records["stamp"], prepend=self._last_stamp)[0 if np.isfinite(self._last_stamp) else 1 :]
            is_lost = int(np.maximum(np.round(gaps / PERIOD) - 1.0, 0.0).sum())  # a restarted controller counts from 0
            self._last_time, self._last_stamp = float(records["time"][-1]), float(records["stamp"][-1])
        return ArmPackages.from_columns(records, is_lost)

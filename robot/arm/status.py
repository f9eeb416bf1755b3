"""Status of an arm: as its records say, the first cause of a lost link with its explanation, and the log of the
packages of its controller.

A cut link may crash ur_rtde 1.6.5: its threads close the same connection at the same time, and the worker ends before
it can publish its status. The library always reports the lost connection on standard error first. That report separates
a lost link from a worker that ended for another reason.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np

from robot.arm.channel import STATISTICS_PERIODS, Record, Ring
from robot.arm.trajectory import PERIOD
from robot.common.process import Child
from robot.errors import (
    DeviceBusyError,
    DeviceError,
    DeviceNotConnectedError,
    EmergencyStop,
    LinkLost,
    ProtectiveStop,
    SafetyViolation,
)
from tacsim.record.episode import ArmPackages

if TYPE_CHECKING:
    from tacsim.models.hardware import UrArmConfig

LOST_LINK_REPORTS = (  # by ur_rtde 1.6.5, after each failure of a connection and before it uses that connection again
    "Lost connection to robot",
    "Could not receive data from robot",
    "Robot closed the connection",
)


class ArmStatus(IntEnum):
    """Status of an arm. States below FORCE_LIMIT end by themselves; the others are faults, until `recover`."""

    CONNECTING = 0
    OK = 1  # follows its target
    HOLD = 2  # at rest: no command yet, stop(), or no action within action_timeout
    OUT_OF_REACH = 3  # at rest or braking: a joint limit or a singularity blocks the path to the target
    WAITING = 4  # at rest: the other arm of a keep-out is not connected, or has a fault
    OBSERVATION_STALE = 5  # at rest: the last observation is older than observation_timeout
    FORCE_LIMIT = 10
    WORKSPACE_LIMIT = 11
    KEEP_OUT = 12  # came too near to the other arm
    PARTNER_STOPPED = 13  # the other arm of a keep-out stopped, or its state is unknown
    GEL_LIMIT = 14  # its gel was pressed or dragged too far
    OFF_PATH = 15  # left its path to the start
    NOT_FOLLOWING = 16  # was more than limits.following_error away from the pose that was sent
    PROGRAM_STOPPED = 20  # on the controller: its watchdog, the pendant, or power
    OTHER_PROGRAM = 21  # moves the arm: the controller's own target moves while ours is at rest
    PROTECTIVE_STOP = 22
    EMERGENCY_STOP = 23  # also a safeguard stop, a safety violation, a fault
    LINK_LOST = 30
    WORKER_DEAD = 31
    CLOSED = 32

    @property
    def is_fault(self) -> bool:
        return self >= ArmStatus.FORCE_LIMIT

    @property
    def is_controller_stop(self) -> bool:
        """True if our program does not run or the controller has stopped it; then nothing is sent."""
        return ArmStatus.PROGRAM_STOPPED <= self < ArmStatus.LINK_LOST

    @property
    def text(self) -> str:
        """Meaning of the status, and what to do."""
        return _TEXTS[self]

    @property
    def error(self) -> type[DeviceError]:
        """Class of the error that a command raises in this state."""
        return _ERRORS.get(self, SafetyViolation)


_TEXTS = {
    ArmStatus.CONNECTING: "is connecting",
    ArmStatus.OK: "follows its target",
    ArmStatus.HOLD: "stands still: no fresh action",
    ArmStatus.OUT_OF_REACH: "cannot continue to its target: a joint limit, a joint speed or a singularity prevents it",
    ArmStatus.WAITING: "stands still: the other arm of a keep-out is not connected, or has a fault",
    ArmStatus.OBSERVATION_STALE: "stands still: the last observation is older than observation_timeout; "
    "check the cameras",
    ArmStatus.FORCE_LIMIT: "exceeded limits.force or limits.torque and stopped; find the cause, then recover()",
    ArmStatus.WORKSPACE_LIMIT: "is outside its workspace and stopped; bring it back with the pendant, then recover()",
    ArmStatus.KEEP_OUT: "came too near to the other arm and stopped; find the cause, then recover()",
    ArmStatus.PARTNER_STOPPED: "stopped because the other arm stopped, or did not report in time; recover() "
    "that one, then this",
    ArmStatus.GEL_LIMIT: "pressed or dragged its gel farther than limits.depth or limits.shear and stopped; move it "
    "away, then recover()",
    ArmStatus.OFF_PATH: "left its path to the start and stopped; find the cause, then start again",
    ArmStatus.NOT_FOLLOWING: "did not follow: it was more than limits.following_error away from its sent pose, and "
    "stopped; check whether something holds it, a joint lags or another program moves it, then recover()",
    ArmStatus.OTHER_PROGRAM: "is moved by another program on its controller, and no target is sent; end that program, "
    "then recover()",
    ArmStatus.PROGRAM_STOPPED: "has no running program (watchdog, pendant or power); find the cause, then recover()",
    ArmStatus.PROTECTIVE_STOP: "made a protective stop; find the cause, then recover()",
    ArmStatus.EMERGENCY_STOP: "has an emergency or safeguard stop; a person must release it, then recover()",
    ArmStatus.LINK_LOST: "does not answer; its controller stops it by its own watchdog; find the cause, then recover()",
    ArmStatus.WORKER_DEAD: "lost its worker process; its controller stops it by its watchdog; recover() starts another",
    ArmStatus.CLOSED: "is closed",
}
CONNECTING_ADVICE = {  # further advice
    ArmStatus.FORCE_LIMIT: ". If it has no contact, its force sensor has an offset: `tacsim doctor --rig FILE` shows "
    "it, `tacsim start FILE` zeroes it",
    ArmStatus.WORKSPACE_LIMIT: ". `tacsim doctor --rig FILE` says how to jog it back, `tacsim start FILE` moves it to "
    "its start",
}
_ERRORS: dict[ArmStatus, type[DeviceError]] = {
    ArmStatus.CONNECTING: DeviceNotConnectedError,
    ArmStatus.PROGRAM_STOPPED: ProtectiveStop,
    ArmStatus.OTHER_PROGRAM: DeviceBusyError,
    ArmStatus.PROTECTIVE_STOP: ProtectiveStop,
    ArmStatus.EMERGENCY_STOP: EmergencyStop,
    ArmStatus.LINK_LOST: LinkLost,
    ArmStatus.WORKER_DEAD: DeviceNotConnectedError,
    ArmStatus.CLOSED: DeviceNotConnectedError,
}


def status_of(
    record: Record | None, exit_status: int | None, timeout: float, *, is_link_lost: bool = False
) -> ArmStatus:
    """Present status of an arm, from the newest record of its worker and the worker's exit status (None: it runs).

    A link is lost when the newest package is older than `timeout` [s], unless a call to the controller may take so
    long. `is_link_lost`: the link was lost before the worker ended.
    """
    last = ArmStatus.WORKER_DEAD if record is None else ArmStatus(int(record["status"]))
    if record is None or last == ArmStatus.CONNECTING:
        return last if exit_status is None else ArmStatus.WORKER_DEAD
    if exit_status is not None:
        return ArmStatus.LINK_LOST if is_link_lost or last == ArmStatus.LINK_LOST else ArmStatus.WORKER_DEAD
    fresh = time.monotonic() <= max(float(record["time"]) + timeout, float(record["busy_until"]))
    return last if fresh else ArmStatus.LINK_LOST


def is_healthy(other: Record | None) -> bool:
    """True if the state of the other arm of a keep-out is known and has no fault."""
    if other is None:
        return False
    status = ArmStatus(int(other["status"]))
    return not status.is_fault and status != ArmStatus.CONNECTING


TIME_LIMIT_EXIT_STATUS = -signal.SIGALRM  # exit status of a worker whose call into the library exceeded its time limit


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

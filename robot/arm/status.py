"""Status of an arm as its driver reports it: a name, a sentence, and an error."""

from __future__ import annotations

import time
from enum import IntEnum

from robot.arm.shared_ring import Record
from robot.errors import (
    DeviceBusyError,
    DeviceError,
    DeviceNotConnectedError,
    EmergencyStop,
    LinkLost,
    ProtectiveStop,
    SafetyViolation,
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

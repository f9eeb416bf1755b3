"""What an arm is doing, as its driver tells it: in one word, in a sentence, and as an error."""

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
    """What an arm is doing. States below FORCE_LIMIT end by themselves; the others are faults, until `recover`."""

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
    OFF_WAY = 15  # left its way to the start
    NOT_FOLLOWING = 16  # was farther than limits.following_error from where it was sent
    PROGRAM_STOPPED = 20  # on the controller: its watchdog, the pendant, or power
    OTHER_PROGRAM = 21  # drives the arm: the controller's own target moves where ours rests
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
        """Nothing is sent: our program does not run, or the controller has stopped it."""
        return ArmStatus.PROGRAM_STOPPED <= self < ArmStatus.LINK_LOST

    @property
    def text(self) -> str:
        """What it means, and what to do."""
        return _TEXTS[self]

    @property
    def error(self) -> type[DeviceError]:
        """What a command raises in this state."""
        return _ERRORS.get(self, SafetyViolation)


_TEXTS = {
    ArmStatus.CONNECTING: "is connecting",
    ArmStatus.OK: "follows its target",
    ArmStatus.HOLD: "stands still: no fresh action",
    ArmStatus.OUT_OF_REACH: "cannot go on towards its target: a joint, its speed or a singularity forbids it",
    ArmStatus.WAITING: "stands still: the other arm of a keep-out is not connected, or has a fault",
    ArmStatus.OBSERVATION_STALE: "stands still: the last observation is older than observation_timeout; "
    "check the cameras",
    ArmStatus.FORCE_LIMIT: "felt more than limits.force or limits.torque and stopped; look why, then recover()",
    ArmStatus.WORKSPACE_LIMIT: "is outside its workspace and stopped; bring it back with the pendant, then recover()",
    ArmStatus.KEEP_OUT: "came too near to the other arm and stopped; look why, then recover()",
    ArmStatus.PARTNER_STOPPED: "stopped because the other arm did, or was not heard of in time; recover() that "
    "one, then this",
    ArmStatus.GEL_LIMIT: "pressed or dragged its gel farther than limits.depth or limits.shear and stopped; move it "
    "away, then recover()",
    ArmStatus.OFF_WAY: "left its way to the start and stopped; look why, then begin anew",
    ArmStatus.NOT_FOLLOWING: "did not follow: it was farther than limits.following_error from where it was sent, and "
    "stopped; look whether something holds it, a joint lags or another program moves it, then recover()",
    ArmStatus.OTHER_PROGRAM: "is moved by another program on its controller, and is sent nothing; end that program, "
    "then recover()",
    ArmStatus.PROGRAM_STOPPED: "has no running program (watchdog, pendant or power); look why, then recover()",
    ArmStatus.PROTECTIVE_STOP: "made a protective stop; look why, then recover()",
    ArmStatus.EMERGENCY_STOP: "has an emergency or safeguard stop; a person must release it, then recover()",
    ArmStatus.LINK_LOST: "does not answer any more; the controller stops by its own watchdog; see why, then recover()",
    ArmStatus.WORKER_DEAD: "lost its worker process; the controller stops by its watchdog; recover() starts another",
    ArmStatus.CLOSED: "is closed",
}
AT_CONNECTING = {  # what to do besides
    ArmStatus.FORCE_LIMIT: ". If it touches nothing, its force sensor is off: `tacsim doctor --rig FILE` shows by how "
    "much, `tacsim start FILE` zeroes it",
    ArmStatus.WORKSPACE_LIMIT: ". `tacsim doctor --rig FILE` says how to jog it back, `tacsim start FILE` leads it to "
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


def status_of(record: Record | None, exit_status: int | None, patience: float, *, lost: bool = False) -> ArmStatus:
    """What an arm is doing now, by the newest record of its worker and the exit status of that (None: it runs); lost:
    the link was lost before it ended. A link is lost once the newest package is older than `patience` [s], unless a
    call of the controller may take so long."""
    last = ArmStatus.WORKER_DEAD if record is None else ArmStatus(int(record["status"]))
    if record is None or last == ArmStatus.CONNECTING:
        return last if exit_status is None else ArmStatus.WORKER_DEAD
    if exit_status is not None:
        return ArmStatus.LINK_LOST if lost or last == ArmStatus.LINK_LOST else ArmStatus.WORKER_DEAD
    fresh = time.monotonic() <= max(float(record["time"]) + patience, float(record["busy_until"]))
    return last if fresh else ArmStatus.LINK_LOST


def is_healthy(other: Record | None) -> bool:
    """True if the state of the other arm of a keep-out is known and without a fault."""
    if other is None:
        return False
    status = ArmStatus(int(other["status"]))
    return not status.is_fault and status != ArmStatus.CONNECTING

"""Modes of the robot, of its safety and of its program, by the numbers that the RTDE sends."""

from __future__ import annotations

from enum import IntEnum


class Mode(IntEnum):
    """robot_mode of the RTDE."""

    BOOTING = 2
    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    RUNNING = 7


class Safety(IntEnum):
    """safety_mode of the RTDE."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    SAFEGUARD_STOP = 5
    ROBOT_EMERGENCY_STOP = 7
    FAULT = 9


SAFETY_BITS = {  # safety_status_bits: bit 10 is "stopped due to safety"
    Safety.NORMAL: 1 << 0,
    Safety.REDUCED: 1 << 1,
    Safety.PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    Safety.SAFEGUARD_STOP: 1 << 4 | 1 << 10,
    Safety.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
    Safety.FAULT: 1 << 9 | 1 << 10,
}


class Runtime(IntEnum):
    """runtime_state of the RTDE."""

    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4

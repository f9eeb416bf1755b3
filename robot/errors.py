"""Errors of devices. Every text says what failed, where, and what to do.

Errors of one device name it in their text. After an error that stops an arm (:class:`ProtectiveStop`,
:class:`EmergencyStop`, :class:`SafetyViolation`, :class:`LinkLost`), no motion continues before the operator or
`recover` has cleared it.
"""

from __future__ import annotations

from tacsim.limits import LimitExceeded


class DeviceError(RuntimeError):
    """A device did not do what was requested. Base class of all errors here."""


class DeviceNotConnectedError(DeviceError):
    """A request to a device that is not open, or that cannot be reached."""


class DeviceAlreadyConnectedError(DeviceError):
    """The device was opened a second time without being closed first."""


class DeviceBusyError(DeviceError):
    """The device is in use by another process, or by the teach pendant."""


class StaleObservationError(DeviceError):
    """Data of the device are older than their limit, so no decision may use them."""


class SafetyViolation(DeviceError, LimitExceeded):
    """A limit of the rig (force, workspace, keep-out, depth, shear) was or would be exceeded; the arm stopped."""


class ProtectiveStop(DeviceError):
    """The controller stopped the arm (a collision, a singularity, a limit). `recover` may unlock it."""


class EmergencyStop(DeviceError):
    """An emergency stop or a safeguard is engaged. The operator must release it; this program cannot."""


class LinkLost(DeviceError):
    """No package from the controller within the link's time-out. The arm stops by its own watchdog."""

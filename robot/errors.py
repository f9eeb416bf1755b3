"""What can go wrong between this program and its devices. Every text says what, where, and what to do.

Errors of one device name it in their text. Those that stop an arm (:class:`ProtectiveStop`, :class:`EmergencyStop`,
:class:`SafetyViolation`, :class:`LinkLost`) are never answered by carrying on: a person, or `recover`, comes first.
"""

from __future__ import annotations

from tacsim.limits import LimitExceeded


class DeviceError(RuntimeError):
    """A device did not do what was asked of it. Base of all errors here."""


class DeviceNotConnectedError(DeviceError):
    """The device was asked for something while it is not open, or it could not be reached."""


class DeviceAlreadyConnectedError(DeviceError):
    """The device was opened a second time without being closed."""


class DeviceBusyError(DeviceError):
    """Somebody else holds the device: another process, or the teach pendant."""


class StaleObservationError(DeviceError):
    """What the device delivers is older than its limit: nothing may be decided by it."""


class SafetyViolation(DeviceError, LimitExceeded):
    """A limit of the rig (force, workspace, keep-out, depth, shear) was broken or would have been; the arm stopped."""


class ProtectiveStop(DeviceError):
    """The controller stopped the arm by itself (a collision, a singularity, a limit). `recover` may unlock it."""


class EmergencyStop(DeviceError):
    """An emergency stop or a safeguard is engaged. A person must release it; nothing here does."""


class LinkLost(DeviceError):
    """No package from the controller within the link's time-out. The arm stops by its own watchdog."""

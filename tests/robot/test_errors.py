from __future__ import annotations

import inspect

from robot import errors


def test_one_base_catches_every_error_of_a_device() -> None:
    found = {
        name: kind for name, kind in inspect.getmembers(errors, inspect.isclass) if kind.__module__ == errors.__name__
    }
    assert set(found) == {
        "DeviceAlreadyConnectedError",
        "DeviceBusyError",
        "DeviceError",
        "DeviceNotConnectedError",
        "EmergencyStop",
        "LinkLost",
        "ProtectiveStop",
        "SafetyViolation",
        "StaleObservationError",
    }
    assert all(issubclass(kind, errors.DeviceError) and kind.__doc__ for kind in found.values())

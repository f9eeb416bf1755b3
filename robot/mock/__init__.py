"""Mock hardware that speaks the real wire: UR controllers and cameras on loopback, each in a process of its own.

with MockUR("127.0.0.2") as mock:
    ...  # connect ur_rtde to mock.host
    mock.faults.protective_stop()
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from robot.common import MOCK_SERIAL
from robot.mock.ur.fault_client import FaultClient, FaultError, Input, Inputs, MockState
from robot.mock.ur.handle import MockArms, MockError, MockUR

if TYPE_CHECKING:
    from robot.mock.camera.camera import MockCamera, MockCameraState

Door, DoorError = FaultClient, FaultError  # their names before 0.1, in users' tests

__all__ = [
    "MOCK_SERIAL",
    "Door",
    "DoorError",
    "FaultClient",
    "FaultError",
    "Input",
    "Inputs",
    "MockArms",
    "MockCamera",
    "MockCameraState",
    "MockError",
    "MockState",
    "MockUR",
]


def __getattr__(name: str) -> Any:
    """Cameras are imported when asked for: `python -m robot.mock.camera.camera` must not find itself imported
    already."""
    if name in ("MockCamera", "MockCameraState"):
        from robot.mock.camera import camera

        return getattr(camera, name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")

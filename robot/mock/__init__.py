"""Mock hardware with the real protocols: UR controllers and cameras on loopback, each in a separate process.

with MockUR("127.0.0.2") as mock:
    ...  # connect ur_rtde to mock.host
    mock.faults.protective_stop()
"""

from __future__ import annotations

from robot.common import MOCK_SERIAL
from robot.mock.camera.camera import MockCamera, MockCameraState
from robot.mock.ur.fault_client import FaultClient, FaultError, Input, Inputs, MockState
from robot.mock.ur.handle import MockArms, MockError, MockUR

__all__ = [
    "MOCK_SERIAL",
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

"""Mock hardware that speaks the real wire: UR controllers on loopback, each in a process of its own.

with MockUR("127.0.0.2") as mock:
    ...  # connect ur_rtde to mock.host
    mock.door.protective_stop()
"""

from __future__ import annotations

from robot.mock.controller import SERIAL as MOCK_SERIAL
from robot.mock.door import Door, DoorError, Input, Inputs, MockState
from robot.mock.ur import MockArms, MockError, MockUR

__all__ = ["MOCK_SERIAL", "Door", "DoorError", "Input", "Inputs", "MockArms", "MockError", "MockState", "MockUR"]

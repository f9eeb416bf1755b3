"""The real side of a comparison."""

from __future__ import annotations

import pytest

from calibration.frame_set import FrameSet
from tests.calibration.presses import HiddenSensor
from tests.calibration.sources import side


@pytest.fixture(scope="module")
def real() -> FrameSet:
    return side(HiddenSensor(3), name="real")

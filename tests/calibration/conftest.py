"""Made-up frames of presses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.benchmarks.conftest import dented


@pytest.fixture
def press_image() -> Callable[..., Any]:
    return dented

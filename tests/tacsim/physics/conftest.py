"""With TACSIM_DEVICE the physics suite runs on a device (`make test-gpu`), but for what needs the CPU."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import pytest

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: Sequence[pytest.Item]) -> None:
    """Skips tests marked `cpu`: of its kernels, of its bits (sums on a device are atomic), of the seed's scheme."""
    device = os.environ.get("TACSIM_DEVICE") or "cpu"
    for item in items:
        if device != "cpu" and HERE in item.path.parents and item.get_closest_marker("cpu"):
            item.add_marker(pytest.mark.skip(reason=f"needs the CPU, and TACSIM_DEVICE is '{device}'"))

"""pytest fixtures of mock hardware for users: ``pytest_plugins = ["robot.fixtures"]`` in a conftest.py."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from robot.mock.fixtures import mock_camera as mock_camera
from robot.mock.fixtures import mock_ur as mock_ur
from robot.mock.fixtures import rig_addresses
from robot.open import open_rig
from tacsim.rig import Rig


@pytest.fixture
def mock_rig() -> Iterator[Callable[..., Rig]]:
    """Opens the complete mock cell: `mock_rig("task=reposition", ...)` takes overrides of configs/rigs/mock.yaml."""
    with ExitStack() as stack:

        def opened(*overrides: str, rig: str = "mock", task: str | None = None) -> Rig:
            return stack.enter_context(open_rig(rig, task=task, overrides=[*rig_addresses(), *overrides]))

        yield opened

"""Fixtures of the tests of rigs of hardware."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import robot.rig.reset


@pytest.fixture(scope="module")
def no_pause() -> Iterator[None]:
    """Mock arms do not shake: nothing has to come to rest before their forces are zeroed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(robot.rig.reset, "SETTLING_TIME", 0.02)
        yield

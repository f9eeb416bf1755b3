"""Sources that are replayed in tests: pictures, and what a rig file says of sensors and arms."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tacsim.models.rig import ReplayArmConfig, ReplaySensorConfig


def sensor_facts(source: Path | None, **more: object) -> ReplaySensorConfig:
    return ReplaySensorConfig(driver="replay", source=None if source is None else str(source), **more)


def arm_facts(source: Path | None, **more: object) -> ReplayArmConfig:
    return ReplayArmConfig(driver="replay", source=None if source is None else str(source), **more)


def picture(k: int, size: tuple[int, int] = (20, 30)) -> np.ndarray:
    """Red is 10 k, green 100, blue 200."""
    return np.broadcast_to(np.array([10 * k, 100, 200], np.uint8), (*size, 3)).copy()

"""The driver `hasty`: it does not say how late its pictures are."""

from __future__ import annotations

from typing import Literal

from soft_touch.skin import SkinConfig, SkinDriver
from tacsim import SensorDriver


class HastyConfig(SkinConfig):
    driver: Literal["hasty"]  # type: ignore[assignment]


class HastyDriver(SkinDriver):
    config_class = HastyConfig
    worst_latency = SensorDriver.worst_latency

"""The driver `hasty`: it does not say how late its pictures are."""

from __future__ import annotations

from typing import Literal

from soft_touch.sensor import Config, Driver

from tacsim import SensorDriver


class HastyConfig(Config):
    driver: Literal["hasty"]  # type: ignore[assignment]


class HastyDriver(Driver):
    config_class = HastyConfig
    worst_latency = SensorDriver.worst_latency

"""Configuration of grippers: what all have. Drivers: models/driver.py."""

from __future__ import annotations

from tacsim.models.hardware import Name
from tacsim.models.quantity import Config


class GripperConfig(Config):
    """What a rig file says of one parallel gripper; see SensorConfig."""

    driver: str
    arm: Name | None = None  # that carries it

    @property
    def is_real(self) -> bool:
        """As of an arm."""
        return True

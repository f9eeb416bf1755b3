"""The drivers of a rig's parts, and the companion that runs with its mocks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pkgutil import resolve_name
from typing import Any, cast

from robot.rig import CannotOpen
from tacsim.models.driver import (
    ArmDriver,
    Companion,
    SensorDriver,
    SensorPart,
    arm_part,
    gripper_part,
    installed_drivers,
    sensor_part,
)
from tacsim.models.rig import RigConfig


def sensor_of(config: RigConfig, name: str) -> SensorPart[Any]:
    """The driver of one sensor of a rig. Raises ValueError."""
    gel_size = None if config.scene is None else config.scene.gel_of(name).size[:2]
    return sensor_part(config.sensors[name], name, config.canonical, gel_size)


def sensor_drivers(config: RigConfig) -> dict[str, SensorDriver[Any]]:
    """Drivers by sensor name, of a rig with the wall clock (see `check_parts`)."""
    return {name: cast(SensorDriver[Any], sensor_of(config, name)) for name in config.sensors}


def arm_drivers(config: RigConfig) -> dict[str, ArmDriver[Any]]:
    """Drivers by arm name, of a rig with the wall clock (see `check_parts`)."""
    return {
        name: cast(ArmDriver[Any], arm_part(arm, name, config.keep_out_distances(name)))
        for name, arm in config.arms.items()
    }


def check_parts(config: RigConfig) -> None:
    """Checks that all parts of a rig support its clock, and that each sensor can be opened. Raises CannotOpen."""
    sensors = {name: sensor_of(config, name) for name in config.sensors}
    arms = {name: arm_part(arm, name) for name, arm in config.arms.items()}
    grippers = {name: gripper_part(gripper, name) for name, gripper in config.grippers.items()}
    for kind, parts in (("arm", arms), ("gripper", grippers), ("sensor", sensors)):
        for name, part in parts.items():
            if config.clock in part.clocks:
                continue
            able = [each for each, other in installed_drivers().usable[kind].items() if config.clock in other.clocks]
            raise CannotOpen(
                f"rig '{config.name}': {kind}s.{name} has driver '{part.config.driver}', which does not support clock "
                f"'{config.clock}'; give it driver '{' or '.join(sorted(able))}', or change the clock"
            )
    for sensor in sensors.values():
        try:
            sensor.require()
        except ValueError as failure:
            raise CannotOpen(f"rig '{config.name}': {failure}") from None


def companion_class(config: RigConfig) -> Any:
    """The class of the companion that the mocks of a rig need; None if no device needs one.

    Raises CannotOpen if the mocks need different companions.
    """
    drivers: list[Any] = [*sensor_drivers(config).values(), *arm_drivers(config).values()]
    names = sorted({driver.companion for driver in drivers if driver.companion is not None})
    if len(names) > 1:
        raise CannotOpen(
            f"rig '{config.name}': its mocks need different companions, {' and '.join(names)}; open two rigs"
        )
    return resolve_name(names[0]) if names else None


def start_companion(config: RigConfig) -> Companion | None:
    """Starts the companion of a rig's mocks; None if no device needs one. Raises DeviceError."""
    made = companion_class(config)
    companion: Companion | None = None if made is None else made(config)
    return companion


@contextmanager
def companion_of(config: RigConfig) -> Iterator[Companion | None]:
    """Starts the companion and closes it at the end of the block."""
    companion = start_companion(config)
    try:
        yield companion
    finally:
        if companion is not None:
            companion.close()

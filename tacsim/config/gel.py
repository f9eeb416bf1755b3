"""The gel of a simulated scene, where a calibrated sensor says how large it is."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from pydantic import ValidationError

from tacsim.config.errors import ConfigError, Place, Problem
from tacsim.models.hardware import CameraSensorConfig
from tacsim.models.rig import RigConfig, SimSensorConfig
from tacsim.models.scene import Scene
from tacsim.models.sensor import SensorModel


def with_gels_of_sensors(
    config: RigConfig, load_sensor: Callable[[Path], SensorModel], *, given: bool
) -> tuple[RigConfig, list[str]]:
    """The rig with gels as large as its simulated sensors' own, and that in words.

    load_sensor: reads the model of a mock camera that is given a calibration. given: the size was said on the command
    line, which counts; the models then say none. Raises ConfigError.
    """
    if config.scene is None:
        return config, []
    models: dict[str, SensorModel] = {}
    for name, sensor in config.sensors.items():
        if isinstance(sensor, SimSensorConfig):
            models[name] = sensor.model
        elif isinstance(sensor, CameraSensorConfig) and sensor.mock is not None:
            models[name] = sensor.model if sensor.model is not None else load_sensor(Path(sensor.calibration or ""))
    scene, notes = fit_gel(config.scene, models, given=given)
    update: dict[str, object] = {"scene": scene}
    if given:
        update["sensors"] = {
            name: sensor.model_copy(update={"model": models[name].model_copy(update={"gel_size": None})})
            if name in models and not isinstance(sensor, CameraSensorConfig)
            else sensor
            for name, sensor in config.sensors.items()
        }
    return config.model_copy(update=update), notes


def fit_gel(scene: Scene, models: Mapping[str, SensorModel], *, given: bool = False) -> tuple[Scene, list[str]]:
    """The scene with gels as large along x, y as the largest `gel_size` of `models`, in whole elements, and that in
    words, with what calibrations say against themselves; the scene as it is where no model says a size, or its own was
    `given`. Raises ConfigError for a gel that the scene cannot mesh."""
    doubts = [f"sensor {name}: {model.name}: {model.caution}" for name, model in models.items() if model.caution]
    known = {name: model.gel_size for name, model in models.items() if model.gel_size is not None}
    if not known:
        return scene, doubts
    size = scene.gel.size
    shown = "; ".join(
        f"{_millimetres(each)} by the calibration of {models[name].name} (sensor {name})"
        for name, each in known.items()
    )
    if given:
        return scene, [f"gel {_millimetres(size)}, as said on the command line; {shown}", *doubts]
    element = scene.gel_element
    x, y = (max(2, round(max(each[axis] for each in known.values()) / element)) * element for axis in (0, 1))
    try:
        fitted = Scene.model_validate(scene.model_dump() | {"gel": scene.gel.model_dump() | {"size": (x, y, size[2])}})
    except ValidationError as error:
        why = error.errors(include_url=False)[0]["msg"].removeprefix("Value error, ")
        raise ConfigError([Problem(Place("scene.gel.size"), "", f"{shown}: {why}")]) from None
    words = f"gel {_millimetres((x, y))} in whole elements of {element * 1e3:.3g} mm, {size[2] * 1e3:.3g} mm thick"
    return fitted, [f"{words}: {shown}; the thickness is the scene's", *doubts]


def says_gel_size(path: Iterable[str]) -> bool:
    """An override of this path says how large gels are."""
    keys = [key for key in path if key not in ("task", "scene")]
    return keys[:2] == ["gel", "size"]


def _millimetres(size: tuple[float, ...]) -> str:
    return f"{size[0] * 1e3:.4g} x {size[1] * 1e3:.4g} mm"

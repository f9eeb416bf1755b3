"""The gel size of a simulated scene, from the models of its sensors."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path

from pydantic import ValidationError

from tacsim.config.document import ConfigError, Place, Problem
from tacsim.models.rig import RigConfig
from tacsim.models.scene import Scene
from tacsim.models.sensor import SensorModel
from tacsim.models.text import millimetres


def fit_gels_to_sensors(
    config: RigConfig, load_sensor: Callable[[Path], SensorModel], *, given: Collection[str] = ()
) -> tuple[RigConfig, list[str]]:
    """The rig with the gel sizes of its simulated sensors, and notes about them.

    load_sensor: reads the model of a mock camera with a calibration. given: see `fit_gel`; the gel size is removed from
    the models of sensors for which it was given. Raises ConfigError.
    """
    if config.scene is None:
        return config, []
    models: dict[str, SensorModel] = {}
    for name, sensor in config.sensors.items():
        if (model := sensor.rendered_model(load_sensor)) is not None:
            models[name] = model
    scene, notes = fit_gel(config.scene, models, given=given)
    update: dict[str, object] = {"scene": scene}
    fixed = _overridden_sensors(config.scene, models, given)
    if fixed:
        update["sensors"] = {
            name: sensor.without_gel_size() if name in fixed else sensor for name, sensor in config.sensors.items()
        }
    return config.model_copy(update=update), notes


def fit_gel(
    scene: Scene, models: Mapping[str, SensorModel], *, given: Collection[str] = ()
) -> tuple[Scene, list[str]]:  # fmt: skip
    """The scene with the gel sizes of the sensors' models, x and y (`gel_size`) in whole elements and the thickness
    (`gel_thickness`) where a model gives it, and notes about them, with the cautions of calibrations. If the models
    give one size only, `gel` has it, and so both sensors, unless the scene gives a sensor another size. Sizes that were
    `given` on the command line stay: "gel", or the names of sensors. Raises ConfigError for a gel that the scene cannot
    mesh."""
    notes = [f"sensor {name}: {model.name}: {model.caution}" for name, model in models.items() if model.caution]
    sizes = {name: model.gel_size for name, model in models.items() if model.gel_size is not None}
    origins = {
        name: f"{millimetres(*size)} by the model of {models[name].name} (sensor {name})"
        for name, size in sizes.items()
    }
    fixed = _overridden_sensors(scene, models, given)
    fixed_origins = {name: words for name, words in origins.items() if name in fixed}
    for size in dict.fromkeys(millimetres(*scene.gel_of(name).size[:2]) for name in fixed_origins):
        of = [words for name, words in fixed_origins.items() if millimetres(*scene.gel_of(name).size[:2]) == size]
        notes.insert(0, f"gel {size}, as given on the command line; {'; '.join(of)}")
    wanted = {
        name: _fitted_size(scene, name, size, models[name].gel_thickness)
        for name, size in sizes.items()
        if name not in fixed
    }
    if not wanted:
        return scene, notes
    own = any(each.size is not None or each.element_size is not None for each in scene.gels.values())
    shared = len(set(wanted.values())) == 1 and not own and not fixed
    if scene.object is not None and not shared:
        what = (
            f"both fingers have one gel, and their sensors differ: {'; '.join(origins.values())}; give both one model"
        )
        raise ConfigError([Problem(Place("sensors"), "", f"{what}, or --set scene.gel.size")])
    groups = [list(wanted)] if shared else [[name] for name in wanted]
    for names in reversed(groups):
        name, origin_text = names[0], "; ".join(origins[name] for name in names)
        x, y, thickness = wanted[name]
        element = scene.fitted_element_size(name, thickness)
        scene = _set_gel_size(scene, "gel" if shared else f"gels.{name}", wanted[name], origin_text)
        words = f"gel {millimetres(x, y)} in whole elements of {element * 1e3:.3g} mm, {thickness * 1e3:.3g} mm thick"
        source = "scene" if models[name].gel_thickness is None else "sensor"
        notes.insert(0, f"{words}: {origin_text}; the thickness is the {source}'s")
    return scene, notes


def _fitted_size(
    scene: Scene, name: str, size: tuple[float, float], thickness: float | None
) -> tuple[float, float, float]:
    """x, y in whole elements and thickness of the gel of a sensor; None: the scene's thickness."""
    element = scene.fitted_element_size(name, thickness)
    x, y = (max(2, round(side / element)) * element for side in size)
    return x, y, scene.gel_of(name).size[2] if thickness is None else thickness


def _set_gel_size(scene: Scene, key: str, size: tuple[float, ...], reason: str) -> Scene:
    """The scene with this size of `gel`, or of `gels.NAME`. Raises ConfigError."""
    whole = scene.model_dump()
    part, *names = key.split(".")
    target = whole[part] if not names else whole[part].setdefault(names[0], {})
    target["size"] = size
    try:
        return Scene.model_validate(whole)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]["msg"].removeprefix("Value error, ")
        raise ConfigError([Problem(Place(f"scene.{key}.size"), "", f"{reason}: {first}")]) from None


def overridden_gel_sizes(paths: Iterable[Iterable[str]]) -> frozenset[str]:
    """The gels whose size is in overrides with these paths: "gel", or names of sensors."""
    found: set[str] = set()
    for path in paths:
        match [key for key in path if key not in ("task", "scene")]:
            case ["gel", "size", *_]:
                found.add("gel")
            case ["gels", name, "size", *_]:
                found.add(name)
    return frozenset(found)


def _overridden_sensors(scene: Scene, names: Iterable[str], given: Collection[str]) -> frozenset[str]:
    """The sensors among `names` whose gel size was given."""
    own = {name for name, each in scene.gels.items() if each.size is not None}
    return frozenset(name for name in names if name in given or ("gel" in given and name not in own))

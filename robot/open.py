"""Opens rigs. The only place that asks what kind of sensors and arms stand behind one."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from calibration.errors import error_context
from tacsim.config import LoadedRig, load_rig
from tacsim.control.admittance import held_loads
from tacsim.interface import Arm, Normaliser, SensorSpec, TactileFrame
from tacsim.models.hardware import CameraSensorConfig
from tacsim.models.rig import ReplayArmConfig, ReplaySensorConfig, RigConfig, SimArmConfig, SimSensorConfig
from tacsim.rig import Rig

if TYPE_CHECKING:
    from calibration.normaliser import FrameNormaliser
    from tacsim.control.gel_monitor import GelMonitor
    from tacsim.gym.env import TacsimEnv
    from tacsim.models.scene import Scene
    from tacsim.models.sensor import CanonicalGrid
    from tacsim.physics.world import World
    from tacsim.record.replay import ReplayClock, ReplaySensor
    from tacsim.sim.clock import SimClock
    from tacsim.sim.sensor import SimSensor

RIG_ATTACHMENT = "rig.yaml"  # of an episode: the resolved rig file it was recorded with


class CannotOpen(ValueError):
    """A rig file that is sound in itself describes no rig that can be opened."""


# Which drivers go by which clock. A simulated sensor on hardware shows what the gel at the arm's pose would look like.
ARM_DRIVERS = {"sim": {"sim"}, "replay": {"replay"}, "wall": {"ur"}}
SENSOR_DRIVERS = {"sim": {"sim"}, "replay": {"replay"}, "wall": {"camera", "sim"}}


def open_rig(
    rig: str | Path | LoadedRig | RigConfig,
    *,
    task: str | None = None,
    overrides: Sequence[str] = (),
    confirm: Callable[[str], bool] | None = None,
    dry_run: bool = False,
) -> Rig:
    """Opens a rig by its name ("sim", "mock", "ur5e", "replay"), by the path of its file, or from facts already loaded.

    Use it as a context manager: ``with open_rig("sim") as rig: observation = rig.reset()``. `task` and `overrides` are
    as for tacsim.config.load_rig; facts that are loaded have theirs already. Opening moves nothing. `confirm` asks a
    person a question, and has the answer: a rig with real arms approaches nothing without a yes. `dry_run`: a rig of
    hardware does everything but move.

    Raises:
        ConfigError: the file is wrong.
        CannotOpen: its parts don't make a rig, e.g. a recording is not named.
        DeviceError: an arm, a camera or a mock of them cannot be opened (robot.errors).
        EpisodeError: a recording cannot be read.
    """
    if isinstance(rig, (LoadedRig, RigConfig)):
        if task is not None or overrides:
            raise TypeError("open_rig: task and overrides belong to load_rig; this rig is loaded already")
        config = rig.config if isinstance(rig, LoadedRig) else rig
    else:
        config = load_rig(rig, task=task, overrides=overrides).config
    _check_parts(config)
    if dry_run and config.clock != "wall":
        raise CannotOpen(f"rig '{config.name}': a dry run is for hardware; this rig moves no real or mock arm")
    if config.clock == "wall":
        from robot.rig.hardware_rig import open_hardware

        return open_hardware(config, confirm, dry_run=dry_run)
    return _open_sim(config) if config.clock == "sim" else _open_replay(config)


def make_env(
    task: str = "squeeze",
    rig: str | Path = "sim",
    overrides: Sequence[str] = (),
    render_mode: str | None = None,
) -> TacsimEnv:
    """The Gymnasium environment of a task on a rig; entry point of "tacsim/Squeeze-v0" and its sisters."""
    from tacsim.gym.env import TacsimEnv
    from tacsim.tasks import make_task

    config = load_rig(rig, task=task, overrides=overrides).config
    if config.task is None:
        raise CannotOpen(f"rig '{config.name}' has no task; an environment needs one")
    opened = open_rig(config)
    try:
        return TacsimEnv(opened, make_task(config.task), render_mode)
    except BaseException:
        opened.close()
        raise


def check_sensors(config: RigConfig) -> None:
    """Raises what opening the rig would raise over what its cameras show: CannotOpen,
    calibration.errors.CalibrationError."""
    _check_parts(config)
    cameras = {name: each for name, each in config.sensors.items() if isinstance(each, CameraSensorConfig)}
    if cameras:
        from robot.rig.hardware_rig import camera_normaliser

        for name, camera in cameras.items():
            camera_normaliser(name, camera, config)


def _check_parts(config: RigConfig) -> None:
    """All parts of a rig go by one clock, and every recorded sensor names its recording."""
    parts: dict[str, tuple[str, set[str]]] = {
        f"arms.{name}": (arm.driver, ARM_DRIVERS[config.clock]) for name, arm in config.arms.items()
    }
    parts |= {
        f"sensors.{name}": (sensor.driver, SENSOR_DRIVERS[config.clock]) for name, sensor in config.sensors.items()
    }
    for key, (driver, allowed) in parts.items():
        if driver not in allowed:
            raise CannotOpen(
                f"rig '{config.name}': {key} has driver '{driver}', which cannot go by clock '{config.clock}'; "
                f"give it driver '{' or '.join(sorted(allowed))}', or change the clock"
            )
    for name, sensor in config.sensors.items():
        if isinstance(sensor, CameraSensorConfig) and sensor.model is not None:
            shown = sensor.model.geometry
            if (shown.width, shown.height) != (sensor.width, sensor.height):
                raise CannotOpen(
                    f"rig '{config.name}': sensors.{name} delivers {sensor.width} x {sensor.height} px "
                    f"(width, height), its model '{sensor.model.name}' shows {shown.width} x {shown.height}; "
                    "make them alike"
                )
        if isinstance(sensor, ReplaySensorConfig) and sensor.source is None:
            key = f"sensors.{name}.source"
            raise CannotOpen(f"rig '{config.name}': {key}: no recording given; name one with --set {key}=PATH")


def _open_sim(config: RigConfig) -> Rig:
    """One World seen as sensors, arms and a clock."""
    from calibration.normaliser import normaliser_for_simulation
    from tacsim.compute.threads import map_parallel
    from tacsim.physics.world import make_world
    from tacsim.sim.arm import SimArm
    from tacsim.sim.clock import SimClock
    from tacsim.sim.reset import SimReset

    scene = config.scene
    if scene is None:
        raise CannotOpen(f"rig '{config.name}' simulates, but has no scene; give scene, or a task (which has one)")
    if config.motion != "settled" and scene.physics == "seed":
        raise CannotOpen(
            f"rig '{config.name}': physics 'seed' settles every motion, so it can't go by motion '{config.motion}'; "
            "use physics 'hybrid', or motion 'settled'"
        )
    frames = _driven_frames(config, scene)
    models = {name: sensor for name, sensor in config.sensors.items() if isinstance(sensor, SimSensorConfig)}
    world = make_world(scene)
    clock = SimClock(world, config.period, config.motion)
    sensors = {name: _sim_sensor(world, clock, name, sensor, config) for name, sensor in models.items()}
    arms: dict[str, Arm] = {}
    for name, arm in config.arms.items():
        assert isinstance(arm, SimArmConfig)
        limits = arm.limits
        speed = arm.speed if limits is None else min(arm.speed, limits.speed)
        turn_rate = arm.turn_rate if limits is None else min(arm.turn_rate, limits.turn_rate)
        apart = [(frames[other], distance) for other, distance in config.kept_out(name).items()]
        arms[name] = SimArm(world, clock, frames[name], speed * config.period, turn_rate * config.period, limits, apart)
    task = config.task
    return Rig(
        name=config.name,
        sensors=sensors,
        arms=arms,
        clock=clock,
        normalisers={
            name: normaliser_for_simulation(sensor.model, scene.gel.size[:2], config.canonical)
            for name, sensor in models.items()
        },
        reset=SimReset(world, clock, sensors, *((None, 0.0) if task is None else (task.touch_force, task.placement))),
        truth=None if scene.body is None else world.truth,
        diagnostics=clock.diagnostics,
        gather=map_parallel,
        on_tactile=_gel_monitor(config, sensors),
        admittance=held_loads(config.task),
    )


def _gel_monitor(config: RigConfig, sensors: Mapping[str, SimSensor]) -> GelMonitor | None:
    from tacsim.control.gel_monitor import GelMonitor

    limits = {
        name: arm.limits
        for name, arm in config.arms.items()
        if isinstance(arm, SimArmConfig) and arm.limits is not None
    }
    try:
        return GelMonitor({name: sensor.spec for name, sensor in sensors.items()}, limits, {}) if limits else None
    except ValueError as failure:
        raise CannotOpen(f"rig '{config.name}': {failure}") from None


def _driven_frames(config: RigConfig, scene: Scene) -> dict[str, str]:
    """Which frame of the world each arm moves: the sensor it carries, or the indenter."""
    there = ", ".join(scene.sensors)
    for name in config.sensors:
        if name not in scene.sensors:
            raise CannotOpen(f"rig '{config.name}': scene '{scene.name}' has no sensor '{name}'; it has {there}")
    frames = {sensor.arm: name for name, sensor in config.sensors.items() if sensor.arm is not None}
    if scene.indenter is not None:
        frames.setdefault("indenter", "indenter")
    for name in config.arms:
        if name not in frames:
            raise CannotOpen(
                f"rig '{config.name}': arms.{name} carries no sensor; name it in sensors.NAME.arm, or leave it out"
            )
    carried = [sensor.arm for sensor in config.sensors.values()]
    doubled = sorted({arm for arm in carried if arm is not None and carried.count(arm) > 1})
    if doubled:
        raise CannotOpen(f"rig '{config.name}': arms.{doubled[0]} carries several sensors; a simulated arm carries one")
    return frames


def _sim_sensor(world: World, clock: SimClock, name: str, config: SimSensorConfig, rig: RigConfig) -> SimSensor:
    from tacsim.optics.noise import noise_source
    from tacsim.optics.render import Renderer
    from tacsim.optics.surface import surface_map
    from tacsim.sim.sensor import SimSensor

    assert rig.scene is not None
    model = config.model
    spec = SensorSpec(
        image_shape=(model.geometry.height, model.geometry.width),
        height=True,
        flow=model.markers is not None,
        arm=config.arm,
    )
    sample = partial(surface_map, grid=rig.canonical, markers=model.markers)
    render = Renderer(model, rig.scene.gel.size[:2])
    return SimSensor(world, clock, name, spec, render, sample, noise_source(model, name))


class _Rewind:
    """Start of a replayed episode: the first frame; nothing moves, nothing is touched that was not touched then."""

    def __init__(self, clock: ReplayClock, sensors: Mapping[str, ReplaySensor]) -> None:
        self._clock, self._sensors = clock, sensors

    def clear(self, seed: int) -> Mapping[str, TactileFrame]:
        self._clock.rewind()
        return {name: sensor.reference() for name, sensor in self._sensors.items()}

    def touch(self) -> None:
        """A recording is as it is."""


def _open_replay(config: RigConfig) -> Rig:
    """Recorded sensors and arms. The control period is that of the recording."""
    from tacsim.record.replay import ReplayArm, ReplayClock, ReplaySensor

    there = {
        name: arm for name, arm in config.arms.items() if isinstance(arm, ReplayArmConfig) and arm.source is not None
    }
    recorded = {
        name: sensor if sensor.arm in there else sensor.model_copy(update={"arm": None})
        for name, sensor in config.sensors.items()
        if isinstance(sensor, ReplaySensorConfig)
    }
    clock = ReplayClock(_common_period(config.name, recorded))
    with ExitStack() as stack:
        sensors: dict[str, ReplaySensor] = {}
        normalisers: dict[str, Normaliser] = {}
        for name, sensor in recorded.items():
            sensors[name] = source = ReplaySensor(sensor, name, clock)
            stack.callback(source.close)
            with error_context(f"sensors.{name}"):
                normaliser = _replay_normaliser(sensor, name, source.spec.image_shape, config.canonical)
            if not source.spec.height:  # what the frames don't carry, and the normaliser finds in them
                source.spec = replace(source.spec, height=normaliser.finds_height, flow=normaliser.finds_flow)
            normalisers[name] = normaliser
        arms: dict[str, Arm] = {}
        for name, arm in there.items():
            arms[name] = ReplayArm(arm, name, clock)
            stack.callback(arms[name].close)
        rig = Rig(
            name=config.name,
            sensors=sensors,
            arms=arms,
            clock=clock,
            normalisers=normalisers,
            reset=_Rewind(clock, sensors),
        )
        stack.pop_all()
        return rig


def _common_period(rig: str, sensors: Mapping[str, ReplaySensorConfig]) -> float:
    from tacsim.record.replay import recorded_period

    periods = {name: recorded_period(sensor, name) for name, sensor in sensors.items()}
    shortest, longest = min(periods, key=periods.__getitem__), max(periods, key=periods.__getitem__)
    if periods[longest] > periods[shortest] * 1.01:
        raise CannotOpen(
            f"rig '{rig}': recordings go frame by frame, but sensors.{shortest} has one every "
            f"{periods[shortest]:.4g} s and sensors.{longest} every {periods[longest]:.4g} s; give two of one rate"
        )
    return periods[shortest]


def _replay_normaliser(
    config: ReplaySensorConfig, name: str, image_shape: tuple[int, int], grid: CanonicalGrid
) -> FrameNormaliser:
    """By the corners of the rig file; without them by what an episode says of its own sensor."""
    from calibration.normaliser import normaliser_for_recording, normaliser_for_simulation

    original = None if config.corners is not None else _recorded_rig(Path(config.source or ""))
    sensor = None if original is None else original.sensors.get(name)
    if original is not None and original.scene is not None and isinstance(sensor, SimSensorConfig):
        return normaliser_for_simulation(sensor.model, original.scene.gel.size[:2], grid)
    return normaliser_for_recording(sensor if isinstance(sensor, ReplaySensorConfig) else config, image_shape, grid)


def _recorded_rig(source: Path) -> RigConfig | None:
    """The rig that an episode was recorded with; None where it is not known."""
    from tacsim.record.sources import EPISODES, episode_meta

    if source.suffix.lower() not in EPISODES:
        return None
    text = episode_meta(source).attachments.get(RIG_ATTACHMENT)
    if text is None:
        return None
    with tempfile.TemporaryDirectory() as folder:  # an empty folder: the text can refer to nothing beside it
        path = Path(folder) / RIG_ATTACHMENT
        path.write_bytes(text)
        return load_rig(path).config

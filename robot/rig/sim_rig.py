"""Simulated rigs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from calibration.normaliser import normaliser_for_simulation
from robot.rig import CannotOpen
from tacsim.compute.threads import map_parallel, map_serial
from tacsim.control import GelMonitor, load_controller
from tacsim.interface import Pose, RigSpec, SensorSpec
from tacsim.models.hardware import Placement, parts_of
from tacsim.models.rig import RigConfig, SimArmConfig, SimSensorConfig
from tacsim.models.scene import Scene
from tacsim.models.sensor import SensorModel
from tacsim.models.text import suggest_word
from tacsim.optics.noise import NoiseSource, noise_source
from tacsim.optics.render import Renderer
from tacsim.optics.surface import surface_map
from tacsim.physics.world import World, make_world
from tacsim.rig import Rig
from tacsim.sim.arm import SimArm, wrench_noise_source
from tacsim.sim.clock import SimClock
from tacsim.sim.mount import elastic_mounts
from tacsim.sim.reset import SimReset
from tacsim.sim.scene_world import SceneWorld, StatePool
from tacsim.sim.sensor import SimSensor


@dataclass(frozen=True, slots=True)
class Simulation:
    """A simulated rig, and its parts that vector environments need."""

    rig: Rig
    clock: SimClock
    scene_world: SceneWorld
    sensors: Mapping[str, SimSensor]
    arms: Mapping[str, SimArm]

    def apply_variation(self, config: RigConfig) -> None:
        """Takes light, texture, noise and delay of the sensors, and error, noise, mount, delay of the arms from
        `config`, from the next episode on. Everything else does not change."""
        for name, sensor in parts_of(config.sensors, SimSensorConfig).items():
            self.sensors[name].apply_variation(
                *renderer_and_noise(sensor.model, name, self.scene_world.scene), sensor.delay
            )
        for name, arm in parts_of(config.arms, SimArmConfig).items():
            self.arms[name].set_measurement_errors(
                pose_error(arm.error), arm.delay, wrench_noise_source(arm.noise, name)
            )
        _mount_arms(self.arms, config)


def open_sim(config: RigConfig, check: Callable[[RigSpec], None] | None = None) -> Rig:
    """A rig of sensors, arms and a clock in one simulated world. Raises CannotOpen.

    check: gets its specification before the world is made, which takes seconds; raises to refuse it.
    """
    simulation = simulate(config)
    if check is not None:
        check(simulation.rig.spec)
    simulation.scene_world.world()
    return simulation.rig


def simulate(
    config: RigConfig,
    make: Callable[[Scene], World] | None = None,
    pool: StatePool | None = None,
    *,
    parallel: bool = True,
) -> Simulation:
    """A simulated rig whose world is made when it is first needed.

    make: makes a new world of a scene, `make_world` by default. pool: states after touch, shared between rigs.
    parallel: sensors are read on several threads, if the machine has them; False where rigs run in parallel.
    Raises CannotOpen.
    """
    scene = config.scene
    if scene is None:
        raise CannotOpen(f"rig '{config.name}' simulates, but has no scene; give scene, or a task (which has one)")
    if scene.object is not None:
        raise CannotOpen(
            f"rig '{config.name}': scene '{scene.name}' has a rigid object, which only MuJoCo moves; use clock "
            "'mujoco' and drivers 'mujoco', as the rig 'hand' does"
        )
    if config.motion != "settled" and scene.physics == "seed":
        raise CannotOpen(
            f"rig '{config.name}': physics 'seed' settles every motion, so motion '{config.motion}' is not possible; "
            "use physics 'hybrid', or motion 'settled'"
        )
    frames = _frame_of_arm(config, scene)
    models = parts_of(config.sensors, SimSensorConfig)
    world = SceneWorld(scene, make_world if make is None else make)
    clock = SimClock(world, config.period, config.motion)
    sensors = {name: _make_sensor(world, clock, name, sensor, config) for name, sensor in models.items()}
    arms: dict[str, SimArm] = {}
    for name, arm in parts_of(config.arms, SimArmConfig).items():
        limits = arm.limits
        speed = arm.speed if limits is None else min(arm.speed, limits.speed)
        turn_rate = arm.turn_rate if limits is None else min(arm.turn_rate, limits.turn_rate)
        keep_out = [(frames[other], distance) for other, distance in config.keep_out_distances(name).items()]
        max_shift, max_turn = speed * config.period, turn_rate * config.period
        noise = wrench_noise_source(arm.noise, name)
        arms[name] = SimArm(
            world, clock, frames[name], max_shift, max_turn, limits, keep_out, pose_error(arm.error), arm.delay, noise
        )
    _mount_arms(arms, config)
    task = config.task
    touch_force, placement = (None, 0.0) if task is None else (task.touch_force, task.placement)
    rig = Rig(
        name=config.name,
        sensors=sensors,
        arms=arms,
        clock=clock,
        normalisers={
            name: normaliser_for_simulation(sensor.model, scene.gel_of(name).size[:2], config.canonical)
            for name, sensor in models.items()
        },
        reset=SimReset(world, clock, sensors, arms, touch_force, placement, pool),
        truth=None if scene.body is None else world.truth,
        diagnostics=clock.diagnostics,
        read_all=map_parallel if parallel else map_serial,
        on_tactile=make_gel_monitor(config, sensors),
        load_control=load_controller(config.task),
    )
    return Simulation(rig, clock, world, sensors, arms)


def pose_error(error: Placement) -> Pose | None:
    """The pose of its frame that an arm reports, in the true one; None: no error."""
    return None if error == Placement() else error.pose


def make_gel_monitor(config: RigConfig, sensors: Mapping[str, SimSensor]) -> GelMonitor | None:
    """Of the arms that have limits; None without. Raises CannotOpen."""
    limits = {name: arm.stop_limits for name, arm in config.arms.items() if arm.stop_limits is not None}
    try:
        return GelMonitor({name: sensor.spec for name, sensor in sensors.items()}, limits, {}) if limits else None
    except ValueError as failure:
        raise CannotOpen(f"rig '{config.name}': {failure}") from None


def _mount_arms(arms: Mapping[str, SimArm], config: RigConfig) -> None:
    configs = {name: arm.mount for name, arm in parts_of(config.arms, SimArmConfig).items()}
    for name, mount in elastic_mounts(configs, config.period).items():
        arms[name].set_mount(mount, [arm.frame for other, arm in arms.items() if other != name])


def _frame_of_arm(config: RigConfig, scene: Scene) -> dict[str, str]:
    """Which frame of the world each arm moves: the sensor it carries, or the indenter."""
    known = ", ".join(scene.sensors)
    for name in config.sensors:
        if name not in scene.sensors:
            raise CannotOpen(f"rig '{config.name}': scene '{scene.name}' has no sensor '{name}'; it has {known}")
    frames = {sensor.arm: name for name, sensor in config.sensors.items() if sensor.arm is not None}
    if scene.indenter is not None:
        frames.setdefault("indenter", "indenter")
    for name in config.arms:
        if name not in frames:
            raise CannotOpen(
                f"rig '{config.name}': arms.{name} carries no sensor; name it in sensors.NAME.arm, or leave it out"
                f"{suggest_word(name, frames)}"
            )
    carried = [sensor.arm for sensor in config.sensors.values()]
    doubled = sorted({arm for arm in carried if arm is not None and carried.count(arm) > 1})
    if doubled:
        raise CannotOpen(f"rig '{config.name}': arms.{doubled[0]} carries several sensors; a simulated arm carries one")
    return frames


def _make_sensor(world: World, clock: SimClock, name: str, config: SimSensorConfig, rig: RigConfig) -> SimSensor:
    assert rig.scene is not None
    model = config.model
    spec = SensorSpec(
        model.image_shape, height=True, flow=model.markers is not None, arm=config.arm, gripper=config.gripper
    )
    sample = partial(surface_map, grid=rig.canonical, markers=model.markers)
    render, noise = renderer_and_noise(model, name, rig.scene)
    return SimSensor(world, clock, name, spec, render, sample, noise, config.delay)


def renderer_and_noise(model: SensorModel, name: str, scene: Scene) -> tuple[Renderer, NoiseSource | None]:
    """What a simulated sensor's pictures are made with."""
    return Renderer(model, scene.gel_of(name).size[:2]), noise_source(model, name)

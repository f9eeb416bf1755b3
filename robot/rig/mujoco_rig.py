"""Rigs in MuJoCo: arms, grippers, tactile sensors and a rigid object in one cell."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from calibration.normaliser import normaliser_for_pictures, normaliser_for_simulation
from robot.common.kinematics import MODELS, Kinematics, matrix
from robot.rig import CannotOpen
from robot.rig.sim_rig import make_gel_monitor, pose_error, renderer_and_noise
from tacsim import pose as se3
from tacsim.compute.threads import map_parallel, map_serial
from tacsim.control import load_controller
from tacsim.interface import FloatArray, Normaliser, Pose, RigSpec, SensorSpec, Truth
from tacsim.models.hardware import parts_of
from tacsim.models.mujoco import MujocoArmConfig, MujocoGripperConfig, MujocoSensorConfig
from tacsim.models.rig import RigConfig
from tacsim.models.scene import Scene
from tacsim.models.sensor import CanonicalGrid
from tacsim.optics.surface import surface_map
from tacsim.physics.grip.shared import GripPlace, SharedGrips
from tacsim.rig import Rig
from tacsim.sim.arm import SimArm, wrench_noise_source
from tacsim.sim.cell.arm import CellArm
from tacsim.sim.cell.cell import Cell, grip_pose
from tacsim.sim.cell.clock import CellClock
from tacsim.sim.cell.description import (
    FREE_HAND,
    TWO_FINGER_85,
    ArmDescription,
    GripperDescription,
    ViewDescription,
    ur5e_links,
)
from tacsim.sim.cell.gripper import CellGripper
from tacsim.sim.cell.motion import MOTIONS
from tacsim.sim.cell.reset import CellReset
from tacsim.sim.cell.resting import RestingCell
from tacsim.sim.cell.scene_cell import SceneCell
from tacsim.sim.cell.user_model import first_joints
from tacsim.sim.cell.view import CellView
from tacsim.sim.engines.mujoco_module import load_mujoco
from tacsim.sim.engines.picture import require_rendering
from tacsim.sim.pads import PadPlace, SharedPads
from tacsim.sim.scene_world import StatePool
from tacsim.sim.sensor import SimSensor

GRIPPERS = {"parallel": (FREE_HAND, (0.0, 60.0)), "2f85": (TWO_FINGER_85, (20.0, 235.0))}  # and their forces [N]
Place = GripPlace | PadPlace  # of what one simulation shares with others, by its motion
UR5E_SEED = np.array([np.pi, -1.2, 1.6, -1.97, -np.pi / 2, 0.0])  # elbow up, the tool down, in front of the base [rad]


@dataclass(frozen=True, slots=True)
class CellSimulation:
    """A rig in MuJoCo, and its parts that environments need."""

    rig: Rig
    clock: CellClock
    scene_world: SceneCell
    sensors: Mapping[str, SimSensor]
    arms: Mapping[str, SimArm]

    def apply_variation(self, config: RigConfig) -> None:
        """As `Simulation.apply_variation` (sim_rig.py)."""
        for name, sensor in parts_of(config.sensors, MujocoSensorConfig).items():
            self.sensors[name].apply_variation(
                *renderer_and_noise(sensor.model, name, self.scene_world.scene), sensor.delay
            )
        for name, arm in parts_of(config.arms, MujocoArmConfig).items():
            self.arms[name].set_measurement_errors(
                pose_error(arm.error), arm.delay, wrench_noise_source(arm.noise, name)
            )


def open_mujoco(config: RigConfig, check: Callable[[RigSpec], None] | None = None) -> Rig:
    """A rig in MuJoCo. Raises CannotOpen.

    check: gets its specification before the cell is made; raises to refuse it.
    """
    simulation = simulate_cell(config)
    if check is not None:
        check(simulation.rig.spec)
    try:
        if config.cameras:
            require_rendering()
        assert simulation.scene_world.cell is not None
    except (ValueError, RuntimeError, ImportError) as failure:
        raise CannotOpen(f"rig '{config.name}': {failure}") from failure
    return simulation.rig


def simulate_cell(
    config: RigConfig, pool: StatePool | None = None, place: Place | None = None, *, parallel: bool = True
) -> CellSimulation:
    """A rig in MuJoCo whose cell is made when it is first needed; place: of its pads among those of others, or of its
    grip, where it rests in each period; the rest as of `simulate` (sim_rig.py). Raises CannotOpen, also where MuJoCo
    is missing."""
    scene = _require_scene(config)
    try:
        load_mujoco()
    except ImportError as failure:
        raise CannotOpen(f"rig '{config.name}' needs MuJoCo: {failure}") from failure
    arm_configs = parts_of(config.arms, MujocoArmConfig)
    gripper_configs = parts_of(config.grippers, MujocoGripperConfig)
    models = parts_of(config.sensors, MujocoSensorConfig)
    carriers = _carriers_of(config, gripper_configs, models)
    described = {name: _describe_gripper(gripper, scene) for name, gripper in gripper_configs.items()}
    motion = MOTIONS[config.motion]
    scene_cell = SceneCell(scene, partial(_make_cell, config, described, place))
    frames = {name: f"{sensor.gripper}/{sensor.side}" for name, sensor in models.items()}
    clock = CellClock(scene_cell, config.period, motion, {frame: name for name, frame in frames.items()})
    sensors = {name: _make_sensor(scene_cell, clock, name, sensor, config) for name, sensor in models.items()}
    arms = {name: _make_arm(scene_cell, clock, name, arm, config) for name, arm in arm_configs.items()}
    grippers = {
        name: CellGripper(scene_cell, clock, name, _width_range(gripper), _force_range(gripper))
        for name, gripper in gripper_configs.items()
    }
    views = {name: CellView(scene_cell, clock, name, view.size) for name, view in config.cameras.items()}
    task = config.task
    touch_force, placement = (None, 0.0) if task is None else (task.touch_force, task.placement)
    arm_of_gripper = {name: arm for name, arm in carriers.items() if arm_configs[arm].start is None}
    _require_touch_force(config, touch_force, arm_of_gripper)
    rig = Rig(
        name=config.name,
        sensors=sensors,
        arms=arms,
        clock=clock,
        normalisers={
            name: _make_normaliser(name, sensor, scene.gel_of(name).size[:2], config.canonical)
            for name, sensor in models.items()
        },
        reset=CellReset(scene_cell, clock, sensors, arms, arm_of_gripper, touch_force, placement, pool, motion),
        truth=partial(_truth, scene_cell, frames),
        diagnostics=clock.diagnostics,
        read_all=map_parallel if parallel else map_serial,
        on_tactile=make_gel_monitor(config, sensors),
        load_control=load_controller(config.task),
        grippers=grippers,
        views={name: view.read for name, view in views.items()},
        on_close=partial(_close_views, views),
    )
    return CellSimulation(rig, clock, scene_cell, sensors, arms)


def places_of(config: RigConfig, count: int) -> list[Place]:
    """Of a number of simulations of a rig, whose launches then are common."""
    if config.motion == "dynamic":
        pads = SharedPads(count)
        return [PadPlace(pads, index) for index in range(count)]
    grips = SharedGrips(count)
    return [GripPlace(grips, index) for index in range(count)]


def _require_scene(config: RigConfig) -> Scene:
    scene = config.scene
    if scene is None or scene.object is None:
        has = "no scene" if scene is None else f"the scene '{scene.name}', which has no object"
        raise CannotOpen(
            f"rig '{config.name}' moves a rigid object in MuJoCo, but has {has}; give scene: hold, another scene with "
            "an object, or a task that has one"
        )
    if config.motion not in MOTIONS:
        raise CannotOpen(
            f"rig '{config.name}': motion '{config.motion}' is not possible with clock 'mujoco'; give motion: "
            f"{' or '.join(MOTIONS)}"
        )
    steps = config.period / scene.timestep
    if config.motion == "dynamic" and (round(steps) < 1 or abs(steps - round(steps)) > 1e-6 * steps):
        raise CannotOpen(
            f"rig '{config.name}': its period of {config.period:g} s is no whole number of timesteps of "
            f"{scene.timestep:g} s; change period, or scene.timestep"
        )
    return scene


def _carriers_of(
    config: RigConfig, grippers: Mapping[str, MujocoGripperConfig], sensors: Mapping[str, MujocoSensorConfig]
) -> dict[str, str]:
    """The arm of each gripper. Raises CannotOpen for an arm without a gripper or with two, and for a finger with two
    sensors."""
    carriers = {name: gripper.arm for name, gripper in grippers.items()}
    for arm in config.arms:
        number = list(carriers.values()).count(arm)
        if number != 1:
            raise CannotOpen(
                f"rig '{config.name}': arms.{arm} carries {number} grippers; in MuJoCo an arm carries one: name the "
                "arm in grippers.NAME.arm"
            )
    fingers: dict[tuple[str, str], str] = {}
    for name, sensor in sensors.items():
        other = fingers.setdefault((sensor.gripper, sensor.side), name)
        if other != name:
            raise CannotOpen(
                f"rig '{config.name}': sensors {other} and {name} are both on the {sensor.side} finger of "
                f"'{sensor.gripper}'; give one of them the other side"
            )
    for name, gripper in grippers.items():
        if gripper.model is None and config.arms[gripper.arm].file is None:  # type: ignore[attr-defined]
            raise CannotOpen(
                f"rig '{config.name}': grippers.{name} has no model, and arms.{gripper.arm} is no MJCF file that could "
                "have its fingers; give it model: parallel"
            )
    return carriers


def _require_touch_force(config: RigConfig, touch_force: float | None, arm_of_gripper: Mapping[str, str]) -> None:
    for name in arm_of_gripper if touch_force is not None else ():
        assert touch_force is not None
        gripper = config.grippers[name]
        assert isinstance(gripper, MujocoGripperConfig)
        least, most = _force_range(gripper)
        if not least <= touch_force <= most:
            raise CannotOpen(
                f"rig '{config.name}': a reset grips with task.touch_force, {touch_force:g} N, and grippers.{name} has "
                f"forces of {least:g} to {most:g} N; change either"
            )


def _width_range(gripper: MujocoGripperConfig) -> tuple[float, float]:
    if gripper.width is not None:
        return gripper.width
    assert gripper.model is not None
    return 0.0, GRIPPERS[gripper.model][0].stroke


def _force_range(gripper: MujocoGripperConfig) -> tuple[float, float]:
    if gripper.force is not None:
        return gripper.force
    assert gripper.model is not None
    return GRIPPERS[gripper.model][1]


def _describe_gripper(gripper: MujocoGripperConfig, scene: Scene) -> GripperDescription:
    shape = GRIPPERS["parallel" if gripper.model is None else gripper.model][0]
    return replace(
        shape,
        arm=gripper.arm,
        stroke=_width_range(gripper)[1],
        max_force=_force_range(gripper)[1],
        speed=shape.speed if gripper.speed is None else gripper.speed,
        joints=gripper.joints,
        tool=gripper.tool,
        pads=gripper.pads,
    )


def _make_cell(
    config: RigConfig, grippers: Mapping[str, GripperDescription], place: Place | None, scene: Scene
) -> Cell:
    """Raises what `Cell` raises."""
    arms: dict[str, ArmDescription] = {}
    starts: dict[str, Pose] = {}
    for name, arm in parts_of(config.arms, MujocoArmConfig).items():
        starts[name] = grip_pose(scene) if arm.start is None else arm.start.pose
        gripper = next(each for each in grippers.values() if each.arm == name)
        arms[name] = _describe_arm(name, arm, gripper, starts[name])
    views = {
        name: ViewDescription(view.position, view.target, view.field_of_view, view.size)
        for name, view in config.cameras.items()
    }
    if config.motion == "dynamic":
        assert not isinstance(place, GripPlace)
        return Cell(scene, arms, grippers, views, starts, place)
    assert not isinstance(place, PadPlace)
    return RestingCell(scene, arms, grippers, views, starts, place)


def _describe_arm(name: str, arm: MujocoArmConfig, gripper: GripperDescription, start: Pose) -> ArmDescription:
    base = arm.world_from_base.pose
    if arm.file is not None:
        begin = first_joints(Path(arm.file), arm.joints)
        return ArmDescription(base=base, file=Path(arm.file), joints=arm.joints, site=arm.flange, begin=begin)
    if arm.model == "free":
        return ArmDescription()
    lengths = MODELS["ur5e"]
    links = ur5e_links(lengths.a2, lengths.a3, lengths.d1, lengths.d4, lengths.d5, lengths.d6)
    begin = _ur5e_joints(name, se3.compose(se3.inverse(base), start), gripper.length)
    return ArmDescription(base=base, links=links, begin=begin)


def _ur5e_joints(name: str, base_from_tool: Pose, length: float) -> FloatArray:
    """Raises ValueError for a pose out of reach."""
    tool = matrix(np.array([0.0, 0.0, length, 0.0, 0.0, 0.0]))
    found = Kinematics("ur5e").inverse(se3.to_matrix(base_from_tool), UR5E_SEED, tool)
    if found is None:
        at = ", ".join(f"{each:.3g}" for each in base_from_tool.position)
        raise ValueError(
            f"arm '{name}' does not reach its start, which is at ({at}) m from its base; change world_from_base or "
            "start"
        )
    return found


def _make_normaliser(
    name: str, sensor: MujocoSensorConfig, gel_size: tuple[float, float], grid: CanonicalGrid
) -> Normaliser:
    """Raises CannotOpen for a model whose pictures do not tell height and flow."""
    make = normaliser_for_simulation if sensor.surface == "gel" else normaliser_for_pictures
    try:
        return make(sensor.model, gel_size, grid)
    except ValueError as failure:
        raise CannotOpen(f"sensors.{name}.surface is picture: {failure}") from failure


def _make_sensor(
    scene_cell: SceneCell, clock: CellClock, name: str, config: MujocoSensorConfig, rig: RigConfig
) -> SimSensor:
    assert rig.scene is not None
    model = config.model
    spec = SensorSpec(model.image_shape, height=True, flow=model.markers is not None, arm=None, gripper=config.gripper)
    sample = partial(surface_map, grid=rig.canonical, markers=model.markers) if config.surface == "gel" else None
    render, noise = renderer_and_noise(model, name, rig.scene)
    return SimSensor(scene_cell, clock, f"{config.gripper}/{config.side}", spec, render, sample, noise, config.delay)


def _make_arm(scene_cell: SceneCell, clock: CellClock, name: str, arm: MujocoArmConfig, config: RigConfig) -> SimArm:
    limits = arm.limits
    speed = arm.speed if limits is None else min(arm.speed, limits.speed)
    turn_rate = arm.turn_rate if limits is None else min(arm.turn_rate, limits.turn_rate)
    return CellArm(
        scene_cell, clock, name, speed * config.period, turn_rate * config.period, limits,
        config.keep_out_distances(name).items(), pose_error(arm.error), arm.delay, wrench_noise_source(arm.noise, name),
    )  # fmt: skip


def _close_views(views: Mapping[str, CellView]) -> None:
    for view in views.values():
        view.close()


def _truth(scene_cell: SceneCell, frames: Mapping[str, str]) -> Truth:
    return replace(scene_cell.truth(), poses={name: scene_cell.pose(frame) for name, frame in frames.items()})

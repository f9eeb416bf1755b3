"""Gymnasium environments of simulated rigs: one, and many whose worlds share launches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from gymnasium.vector import AutoresetMode

from robot.rig import CannotOpen
from robot.rig.sim_rig import Simulation, simulate
from tacsim.gym import encode
from tacsim.gym.env import TacsimEnv, Variant, require_compatible_task
from tacsim.gym.features import FeatureEncoder
from tacsim.gym.vector import CellBatch, Member, SharedBatch, TacsimVectorEnv
from tacsim.models.hardware import ArmConfig, MountConfig, Placement, SensorConfig, parts_of
from tacsim.models.mujoco import MujocoSensorConfig
from tacsim.models.policy import Features
from tacsim.models.rig import RigConfig, SimSensorConfig, WrenchNoise
from tacsim.models.sensor import Lighting
from tacsim.sim.scene_world import StatePool, require_same_gels
from tacsim.tasks import make_task

if TYPE_CHECKING:  # MuJoCo's rigs bring much that others do not need
    from robot.rig.mujoco_rig import CellSimulation

Episodes = Sequence[tuple[RigConfig, str]]  # rigs, each with a description


def open_env(episodes: Episodes, render_mode: str | None, features: Features | None) -> TacsimEnv:
    """An environment of the first of `episodes`; the others are its variants. Raises CannotOpen, ValueError."""
    config = episodes[0][0]
    return _make_env(_simulate(config), config, _make_variants(episodes), render_mode, features)


def _simulate(config: RigConfig) -> Simulation | CellSimulation:
    if config.clock != "mujoco":
        return simulate(config)
    from robot.rig.mujoco_rig import simulate_cell

    return simulate_cell(config)


def open_vector_env(
    episodes: Episodes,
    number: int,
    render_mode: str | None,
    autoreset_mode: str | AutoresetMode,
    features: Features | None,
) -> TacsimVectorEnv:
    """`number` of these environments in one batch. Raises CannotOpen, ValueError."""
    max_environments = 10_000  # more exceed the memory of any machine
    config, variants = episodes[0][0], _make_variants(episodes)
    if number not in range(1, max_environments + 1):
        raise ValueError(f"a vector environment has 1 to {max_environments:,} environments, got {number!r}")
    modes = [mode.value for mode in AutoresetMode]
    if autoreset_mode not in (*AutoresetMode, *modes):
        raise ValueError(f"autoreset_mode must be one of {', '.join(modes)}, got {autoreset_mode!r}")
    if config.scene is None or config.scene.physics == "seed":
        raise CannotOpen(
            f"rig '{config.name}': physics 'seed' does not run in a batch; use physics 'hybrid', or "
            "gymnasium.make_vec(..., vectorization_mode='sync')"
        )
    pool, members = StatePool(), list[Member]()
    if config.clock == "mujoco":
        from robot.rig.mujoco_rig import places_of, simulate_cell

        for place in places_of(config, int(number)):
            cell = simulate_cell(config, pool, place, parallel=False)
            members.append(Member(_make_env(cell, config, variants, render_mode, features), cell.clock))
        return TacsimVectorEnv(members, CellBatch(), autoreset_mode)
    batch = SharedBatch([config.scene] * int(number))
    for index in range(int(number)):
        simulation = simulate(config, partial(batch.world, index), pool, parallel=False)
        members.append(Member(_make_env(simulation, config, variants, render_mode, features), simulation.clock))
    return TacsimVectorEnv(members, batch, autoreset_mode)


def _make_env(
    simulation: Simulation | CellSimulation,
    config: RigConfig,
    variants: Sequence[Variant],
    render_mode: str | None,
    features: Features | None,
) -> TacsimEnv:
    assert config.task is not None
    encoder = None if features is None else FeatureEncoder(features, config.canonical)
    space = encode.space_of_rig(config) if encoder is None else encode.space_of_features(encoder, config)
    return TacsimEnv(
        simulation.rig,
        make_task(config.task),
        render_mode,
        space=space,
        encoder=encoder,
        variants=variants,
        scene_world=simulation.scene_world,
        apply_variation=lambda variant: simulation.apply_variation(config if variant is None else variant),
    )


def _make_variants(episodes: Episodes) -> list[Variant]:
    """All episodes but the first. Raises ValueError for one that changes settings that a reset cannot change."""
    first, variants = episodes[0][0], []
    fixed = _fixed_settings(first)
    for number, (config, words) in enumerate(episodes[1:]):
        if _fixed_settings(config) != fixed:
            raise ValueError(
                f"variant {number} may change nothing but scene, task, light, texture, noise and delay of the sensors, "
                "error, noise, mount and delay of the arms; make another environment for it"
            )
        assert first.scene is not None and first.task is not None and config.scene is not None
        assert config.task is not None
        try:
            require_same_gels(first.scene, config.scene)
            require_compatible_task(first.task, config.task)
        except ValueError as error:
            raise ValueError(f"variant {number}: {error}") from None
        variants.append(Variant(config.task, config.scene, config, words))
    if all(_variation_of(config) == _variation_of(first) for config, _ in episodes):
        variants = [replace(variant, rig=None) for variant in variants]  # nothing to change at a reset
    return variants


def _variation_of(config: RigConfig) -> tuple[object, object]:
    """The settings of a rig that `Simulation.apply_variation` uses."""
    return config.sensors, config.arms


def _fixed_settings(config: RigConfig) -> RigConfig:
    """The settings of a rig that are the same in all episodes of an environment; others are replaced by defaults."""
    neutral_appearance = {
        "lighting": Lighting(),
        "photometric": None,
        "darkness": None,
        "texture": 0.0,
        "texture_seed": 0,
        "skin": 0.0,
        "noise": None,
        "name": "",
    }
    sensors: dict[str, SensorConfig] = {}
    arms: dict[str, ArmConfig] = {}
    simulated: dict[str, SimSensorConfig | MujocoSensorConfig] = {
        **parts_of(config.sensors, SimSensorConfig), **parts_of(config.sensors, MujocoSensorConfig)
    }  # fmt: skip
    for name, sensor in simulated.items():
        sensors[name] = sensor.model_copy(
            update={"model": sensor.model.model_copy(update=neutral_appearance), "delay": 0}
        )
    for name, arm in config.arms.items():
        arms[name] = arm.model_copy(
            update={"error": Placement(), "noise": WrenchNoise(), "mount": MountConfig(), "delay": 0}
        )
    return config.model_copy(update={"scene": None, "task": None, "sensors": sensors, "arms": arms})

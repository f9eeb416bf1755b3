"""Gymnasium environments of simulated rigs: one, and many whose worlds share launches."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from gymnasium.vector import AutoresetMode

from robot.rig import CannotOpen
from robot.rig.sim_rig import Simulation, simulate
from tacsim.features.encoder import FeatureEncoder
from tacsim.gym import encode
from tacsim.gym.env import TacsimEnv, Variant, require_alike
from tacsim.gym.vector import Member, SharedBatch, TacsimVectorEnv
from tacsim.models.features import Features
from tacsim.models.rig import RigConfig
from tacsim.sim.stage import StatePool, require_same_gels
from tacsim.tasks import make_task


def open_env(configs: Sequence[RigConfig], render_mode: str | None, features: Features | None) -> TacsimEnv:
    """An environment of the first of `configs`; the others are its variants. Raises CannotOpen, ValueError."""
    variants = _variants(configs)
    return _env(simulate(configs[0]), configs[0], variants, render_mode, features)


def open_vector_env(
    configs: Sequence[RigConfig],
    number: int,
    render_mode: str | None,
    autoreset_mode: str | AutoresetMode,
    features: Features | None,
) -> TacsimVectorEnv:
    """`number` of these environments in one batch. Raises CannotOpen, ValueError."""
    config, variants = configs[0], _variants(configs)
    if number < 1:
        raise ValueError(f"a vector environment needs at least one environment, got {number}")
    modes = [mode.value for mode in AutoresetMode]
    if autoreset_mode not in (*AutoresetMode, *modes):
        raise ValueError(f"autoreset_mode must be one of {', '.join(modes)}, got {autoreset_mode!r}")
    if config.scene is None or config.scene.physics == "seed":
        raise CannotOpen(
            f"rig '{config.name}': physics 'seed' does not run in a batch; use physics 'hybrid', or "
            "gymnasium.make_vec(..., vectorization_mode='sync')"
        )
    batch, pool = SharedBatch([config.scene] * number), StatePool()
    members = []
    for index in range(number):
        simulation = simulate(config, partial(batch.world, index), pool, parallel=False)
        members.append(Member(_env(simulation, config, variants, render_mode, features), simulation.clock))
    return TacsimVectorEnv(members, batch, autoreset_mode)


def _env(
    simulation: Simulation,
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
        stage=simulation.stage,
    )


def _variants(configs: Sequence[RigConfig]) -> list[Variant]:
    """All but the first. Raises ValueError for one that changes what an environment cannot change at a reset."""
    first, variants = configs[0], []
    for number, config in enumerate(configs[1:]):
        same = {"scene": None, "task": None}
        if config.model_copy(update=same) != first.model_copy(update=same):
            raise ValueError(f"variant {number} may change nothing but scene and task; make another environment for it")
        assert first.scene is not None and first.task is not None and config.scene is not None
        assert config.task is not None
        try:
            require_same_gels(first.scene, config.scene)
            require_alike(first.task, config.task)
        except ValueError as error:
            raise ValueError(f"variant {number}: {error}") from None
        variants.append(Variant(config.task, config.scene))
    return variants

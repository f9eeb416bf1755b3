"""Opens rigs: chooses the kind of rig by the drivers that its file names."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from pydantic import BaseModel, ValidationError

from robot.common.code import CodeNotFound as CodeNotFound
from robot.common.code import load_attribute
from robot.rig import RIG_ATTACHMENT as RIG_ATTACHMENT
from robot.rig import CannotOpen as CannotOpen
from robot.rig.parts import check_parts, sensor_drivers
from tacsim.config import ConfigError, LoadedRig, load_model, load_rig
from tacsim.config.document import Place, Problem
from tacsim.config.kinds import is_name
from tacsim.config.load import require_texts
from tacsim.interface import RigSpec
from tacsim.models.policy import Features
from tacsim.models.randomisation import Randomisation
from tacsim.models.rig import RigConfig
from tacsim.models.task import TaskConfig
from tacsim.rig import Rig

if TYPE_CHECKING:
    from gymnasium.vector import AutoresetMode

    from robot.rig.sharded_env import ShardedVectorEnv
    from tacsim.gym.env import TacsimEnv
    from tacsim.gym.vector import TacsimVectorEnv

Model = TypeVar("Model", bound=BaseModel)
FeatureSettings = Features | Mapping[str, Any] | Literal["default"] | None
RandomiseSettings = Randomisation | Mapping[str, Any] | str | Path | None

# First overrides of an environment of a simulated rig; user overrides follow.
LEARNING = ("scene.preset=learn", "motion=flowing")


def load_with_task(rig: str | Path, task: str | TaskConfig | None = None, overrides: Sequence[str] = ()) -> LoadedRig:
    """`load_rig`, whose task may also be user-defined, "package.module:attribute": the configuration of a task, or its
    class, which must have defaults for all fields.

    Runs code of that module, so name only modules that you trust. Raises ConfigError, and CodeNotFound for a name that
    refers to no task.
    """
    if isinstance(task, str) and ":" in task:
        try:
            found = load_attribute(task)
        except CodeNotFound as failure:
            raise CodeNotFound(f"task {failure}") from failure
        task = _task_of(found, task)
    return load_rig(rig, task=task, overrides=overrides)


def _task_of(found: object, name: str) -> TaskConfig:
    if isinstance(found, type) and issubclass(found, TaskConfig):
        try:
            found = found.model_validate({})
        except ValueError as failure:
            raise CodeNotFound(f"task '{name}': not all its fields have a default: {failure}") from failure
    if not isinstance(found, TaskConfig):
        raise CodeNotFound(f"task '{name}' is a {type(found).__name__}, not the configuration of a task")
    return found


def open_rig(
    rig: str | Path | LoadedRig | RigConfig,
    *,
    task: str | TaskConfig | None = None,
    overrides: Sequence[str] = (),
    confirm: Callable[[str], bool] | None = None,
    dry_run: bool = False,
    check: Callable[[RigSpec], None] | None = None,
    report: Callable[[str], None] = lambda words: None,
) -> Rig:
    """Opens a rig by its name ("sim", "mock", "ur5e", "replay"), the path of its file, or a loaded configuration.

    Use it as a context manager: ``with open_rig("sim") as rig: observation = rig.reset()``. Opening moves nothing.

    Args:
        task, overrides: as for `load_with_task`; not for a configuration that is loaded already.
        confirm: asks the operator a question and returns the answer; real arms approach only after True.
        dry_run: a rig of hardware does everything except motion.
        check: gets the specification of the rig before any hardware or simulated world is opened; raises to refuse it.
        report: gets a short text about what the arms of hardware are doing in a reset, repeatedly.

    Raises:
        ConfigError: the file is wrong.
        CannotOpen: its parts do not make a rig, e.g. no recording is named.
        DeviceError: an arm, a camera or a mock of them cannot be opened (robot.errors).
        EpisodeError: a recording cannot be read.
    """
    if isinstance(rig, (LoadedRig, RigConfig)):
        if task is not None or overrides:
            raise TypeError("open_rig: task and overrides belong to load_rig; this rig is loaded already")
        config = rig.config if isinstance(rig, LoadedRig) else rig
    else:
        config = load_with_task(rig, task, overrides).config
    check_parts(config)
    if dry_run and config.clock != "wall":
        raise CannotOpen(f"rig '{config.name}': a dry run is for hardware; this rig moves no real or mock arm")
    if config.clock == "wall":  # each kind imports only what it needs
        from robot.rig.hardware_rig import open_hardware

        return open_hardware(config, confirm, dry_run=dry_run, check=check, report=report)
    if config.clock == "sim":
        from robot.rig.sim_rig import open_sim

        return open_sim(config, check)
    if config.clock == "mujoco":
        from robot.rig.mujoco_rig import open_mujoco

        return open_mujoco(config, check)
    from robot.rig.replay_rig import open_replay

    opened = open_replay(config)
    if check is not None:
        try:
            check(opened.spec)
        except BaseException:
            opened.close()
            raise
    return opened


def rig_spec(config: RigConfig) -> RigSpec:
    """The specification of the rig, before any device is opened; for a replay its recording is read.

    Raises the errors of open_rig for a wrong file, a calibration and a recording.
    """
    check_parts(config)
    if config.clock == "wall":
        from robot.rig.hardware_rig import hardware_spec

        return hardware_spec(config)
    if config.clock == "sim":
        from robot.rig.sim_rig import simulate

        return simulate(config).rig.spec
    if config.clock == "mujoco":
        from robot.rig.mujoco_rig import simulate_cell

        return simulate_cell(config).rig.spec
    from robot.rig.replay_rig import open_replay

    with open_replay(config) as opened:
        return opened.spec


def make_env(
    task: str | TaskConfig = "squeeze",
    rig: str | Path = "sim",
    overrides: Sequence[str] = (),
    render_mode: str | None = None,
    variants: Sequence[Sequence[str]] = (),
    randomise: RandomiseSettings = None,
    features: FeatureSettings = "default",
    learning: bool = True,
) -> TacsimEnv:
    """The Gymnasium environment of a task on a rig; entry point of "tacsim.gym:tacsim/Squeeze-v0" and the other tasks.

    variants: overrides of scene and task, on top of `overrides`; each reset draws one of them from its seed. The state
    of first contact of each is computed once. The world of a simulated rig is made at the first reset.
    randomise: draws the variants (`tacsim.Randomisation`, a mapping of its fields, or the name or path of its file).
    features: the observations from which a policy learns (`tacsim.Features`, or a mapping of its fields). "default":
    heights and touch features of order 1 (`default_features`). None: the complete observation, including images, in SI
    units.
    learning: the shipped simulated rig has preset `learn` and motion `flowing` (LEARNING), unless `overrides` change
    them. False, and for a user-defined rig file: as in the files.

    Raises the errors of open_rig, IncompatibleRig for features that the rig does not have, and ValueError for variants
    that change fixed settings (`TacsimEnv.reset`).
    """
    episodes = _rigs_of_episodes(task, rig, overrides, _draw_variants(variants, randomise), learning)
    first = episodes[0][0]
    features_of_rig = _resolve_features(features, first)
    if first.clock in ("sim", "mujoco"):
        from robot.rig.sim_env import open_env

        return open_env(episodes, render_mode, features_of_rig)
    if len(episodes) > 1:
        raise CannotOpen(f"rig '{first.name}' is not simulated, so it has no variants")
    return _env_of_hardware(first, render_mode, features_of_rig)


def make_vector_env(
    num_envs: int = 1,
    task: str | TaskConfig = "squeeze",
    rig: str | Path = "sim",
    overrides: Sequence[str] = (),
    render_mode: str | None = None,
    variants: Sequence[Sequence[str]] = (),
    autoreset_mode: str | AutoresetMode = "NextStep",
    randomise: RandomiseSettings = None,
    features: FeatureSettings = "default",
    learning: bool = True,
) -> TacsimVectorEnv:
    """`num_envs` of these environments, whose simulations share launches, as for ``gymnasium.make_vec``.

    Raises the errors of `make_env`, and CannotOpen for a rig that is not simulated, or with physics 'seed'.
    """
    episodes = _rigs_of_episodes(task, rig, overrides, _draw_variants(variants, randomise), learning)
    if episodes[0][0].clock not in ("sim", "mujoco"):
        raise CannotOpen(
            f"rig '{episodes[0][0].name}' is not simulated: only simulations run many at once; use robot.make_env"
        )
    from robot.rig.sim_env import open_vector_env

    return open_vector_env(episodes, num_envs, render_mode, autoreset_mode, _resolve_features(features, episodes[0][0]))


def make_sharded_env(
    num_envs: int, *arguments: Any, processes: int | None = None, cluster: str | None = None, **options: Any
) -> ShardedVectorEnv:
    """`make_vector_env` with its environments in several processes, each with a part of them. The results are the same,
    bit for bit; on several cores they come earlier.

    processes: None: one for each core, or for each CPU of the cluster.
    cluster: address of a Ray cluster on whose nodes they run: "HOST:PORT", "auto" or "local".

    Raises the errors of `make_vector_env`, robot.rig.sharded_env.WorkerFailed, robot.common.cluster.ClusterError.
    """
    from robot.rig.sharded_env import ShardedVectorEnv

    given = inspect.signature(make_vector_env).bind(num_envs, *arguments, **options).arguments
    del given["num_envs"]
    return ShardedVectorEnv(make_vector_env, given, num_envs, processes, cluster)


def _draw_variants(variants: Sequence[Sequence[str]], randomise: RandomiseSettings) -> Sequence[Sequence[str]]:
    if not isinstance(variants, Sequence):
        raise TypeError(f"variants are a list of lists of overrides, [['task.goal=6 mm']]; {variants!r} was given")
    if randomise is None:
        return variants
    if variants:
        raise ValueError("give variants, or a randomisation that draws them, not both")
    if isinstance(randomise, (str, Path)):
        return load_model(Randomisation, randomise).draw_overrides()
    return _validate_argument(Randomisation, randomise, "randomise").draw_overrides()


def _resolve_features(given: FeatureSettings, config: RigConfig) -> Features | None:
    if isinstance(given, str) and given == "default":
        from tacsim.gym.features import default_features

        return default_features(config.canonical, tuple(config.sensors), tuple(config.arms))
    return None if given is None else _validate_argument(Features, given, "features")


def _validate_argument(model: type[Model], given: Model | Mapping[str, Any], argument: str) -> Model:
    """The model that an `argument` of a call is, or that its fields give. Raises ConfigError."""
    try:
        return given if isinstance(given, model) else model.model_validate(given)
    except ValidationError as error:
        problems = [Problem(Place(argument), ".".join(map(str, each["loc"])), each["msg"]) for each in error.errors()]
        raise ConfigError(problems) from None


def _env_of_hardware(config: RigConfig, render_mode: str | None, features: Features | None) -> TacsimEnv:
    """The environment of a rig of hardware, which may have ground truth of its body from a mock."""
    from tacsim.gym.env import TacsimEnv
    from tacsim.gym.features import FeatureEncoder
    from tacsim.tasks import make_task

    opened, task = open_rig(config), config.task
    assert task is not None
    try:
        encoder = None if features is None else FeatureEncoder(features, config.canonical)
        return TacsimEnv(opened, make_task(task), render_mode, encoder=encoder)
    except BaseException:
        opened.close()
        raise


def _rigs_of_episodes(
    task: str | TaskConfig,
    rig: str | Path,
    overrides: Sequence[str],
    variants: Sequence[Sequence[str]],
    learning: bool,
) -> list[tuple[RigConfig, str]]:
    """The rig without a variant, then with each variant; each with the overrides of the variant as text."""
    found: list[tuple[RigConfig, str]] = []
    given = require_texts(overrides)
    shipped = isinstance(rig, str) and is_name(rig)
    if learning and shipped and load_with_task(rig, task, given).config.clock == "sim":
        given = [*LEARNING, *given]
    for more in ((), *variants):
        try:
            config = load_with_task(rig, task, [*given, *require_texts(more)]).config
        except ConfigError as error:
            if not more:
                raise
            of = Problem(Place(f"variant {len(found) - 1}"), "", "; ".join(more))
            raise ConfigError([*error.problems, of]) from None
        if config.task is None:
            raise CannotOpen(f"rig '{config.name}' has no task; an environment needs one")
        check_parts(config)
        found.append((config, "; ".join(more)))
    return found


def check_sensors(config: RigConfig) -> None:
    """Raises the errors that opening the rig would raise about its sensors of hardware: CannotOpen,
    calibration.errors.CalibrationError."""
    check_parts(config)
    if config.clock == "wall":
        for driver in sensor_drivers(config).values():
            driver.normaliser()

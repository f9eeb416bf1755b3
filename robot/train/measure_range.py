"""Measures the range of observations of a policy in its training episodes and writes it to its file. Needs no torch."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from robot.common.whole_file import write_whole
from robot.deploy.onnx_policy import OnnxPolicy
from robot.deploy.policy import require_fit
from robot.deploy.training_range import extract_numbers, fit_training_range
from robot.open import load_with_task, make_vector_env
from tacsim.gym.vector import TacsimVectorEnv
from tacsim.interface import FloatArray
from tacsim.models.policy import METADATA_KEY, Training, TrainingRange
from tacsim.models.scene import Scene
from tacsim.models.sensor import CanonicalGrid
from tacsim.tasks import make_task
from tacsim.tasks.task import BadDraws

ReportProgress = Callable[[str, int, int], None]


def measure_range(
    path: Path,
    training: Training | None = None,
    episodes: int | None = None,
    report_progress: ReportProgress = lambda words, done, of: None,
) -> TrainingRange:
    """Measures the range of the policy in `path` while it acts in episodes drawn as in `training` (None: the training
    in the file's metadata). The number of episodes is rounded up to full rounds of all environments.

    Raises PolicyNotFound, IncompatibleRig, ValueError if the file does not contain its training, and the errors of
    `make_vector_env`.
    """
    episodes_each = 4  # default number of episodes of each environment
    if training is None:
        training = _training_of(path)
    config = load_with_task(training.rig, training.task, training.overrides).config
    assert config.task is not None
    policies = [OnnxPolicy(path, config.canonical, make_task(config.task).goal)]
    envs = make_vector_env(
        training.environments,
        training.task,
        training.rig,
        training.overrides,
        randomise=training.randomise,
        features=policies[0].spec.features,
        learning=False,  # preset and motion are in the training file
    )
    rounds = -(-max(2, episodes or episodes_each * envs.num_envs) // envs.num_envs)
    features: list[FloatArray] = []
    try:
        first = envs.members[0]
        require_fit(first.rig.name, first.rig.spec, policies[0], path.name, first.task)
        for number in range(rounds):
            words = f"observing: round {number + 1} of {rounds}"
            features += _play_round(envs, path, config.canonical, number, partial(report_progress, words))
        return fit_training_range(features, _scenes(training, envs))
    finally:
        envs.close()


def write_range(path: Path, out: Path, found: TrainingRange) -> None:
    """Writes the policy in `path` to `out`, with the range `found` in its metadata."""
    import onnx

    model = onnx.load(str(path))
    policy = {each.key: each.value for each in model.metadata_props}
    spec = OnnxPolicy.spec_of(path).model_copy(update={"range": found})
    onnx.helper.set_model_props(model, {**policy, METADATA_KEY: spec.model_dump_json()})
    write_whole(out, model.SerializeToString())


def _training_of(path: Path) -> Training:
    training_data = OnnxPolicy.spec_of(path).trained.get("training")
    if training_data is None:
        raise ValueError(f"policy '{path}' has no training in its metadata: give its training file (--training)")
    return Training.model_validate(training_data)


def _scenes(training: Training, envs: TacsimVectorEnv) -> list[Scene]:
    """The drawn scenes and those at the limits of the random draws."""
    drawn = [variant.scene for variant in envs.members[0].variants]
    ends = [] if training.randomise is None else training.randomise.limits()
    for words in [*ends, *([] if drawn else [[]])]:
        scene = load_with_task(training.rig, training.task, [*training.overrides, *words]).config.scene
        assert scene is not None
        drawn.append(scene)
    return drawn


def _play_round(
    envs: TacsimVectorEnv,
    path: Path,
    canonical: CanonicalGrid,
    number: int,
    report_progress: Callable[[int, int], None],
) -> list[FloatArray]:
    """Numbers (steps, n) of one episode of each environment; each draws another body."""
    members, count = envs.members, envs.num_envs
    for at, env in enumerate(members):
        env.next_variant = (number * count + at) % len(env.variants) if env.variants else None
    seeds: list[int | None] = [number * count + at for at in range(count)]
    try:
        features, _ = envs.reset(seed=seeds)
    except BadDraws:  # a variant that cannot begin, as in training: others are drawn
        for env in members:
            env.next_variant = None
        features, _ = envs.reset(seed=seeds)
    policies = [OnnxPolicy(path, canonical, env.task.goal) for env in members]
    found: list[list[FloatArray]] = [[] for _ in members]
    over = np.zeros(count, np.bool_)
    idle = np.zeros(envs.single_action_space.shape or (), np.float32)
    steps = members[0].task.config.steps
    while not over.all():
        report_progress(len(found[int(np.argmin(over))]), steps)
        actions = []
        for at, (env, policy) in enumerate(zip(members, policies, strict=True)):
            if over[at]:
                actions.append(idle)
                continue
            found[at].append(
                extract_numbers({key: value[at] for key, value in features.items()}, policy.spec.features.frames)
            )
            actions.append(env.policy_action(policy))
        features, _, terminated, truncated, _ = envs.step(np.stack(actions))
        over |= terminated | truncated
    return [np.array(each) for each in found]

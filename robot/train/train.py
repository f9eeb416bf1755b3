"""A training run: rounds of acting and learning, a checkpoint after each, a policy file at the end.

A round is a function of the settings, its number and the state after the round before; so a run that was killed
anywhere goes on from its last checkpoint to the same end, bit for bit.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from gymnasium.vector import AutoresetMode

from robot.common.whole_file import write_whole
from robot.open import load_with_task, make_vector_env
from robot.train.dagger import Dagger
from robot.train.measure_range import measure_range, write_range
from robot.train.network import PolicyNetwork, export
from robot.train.run_folder import RunError, RunFolder, Tell, version
from tacsim.config import ConfigError
from tacsim.config.errors import Place, Problem
from tacsim.geometry.shapes import bounding_size
from tacsim.gym.encode import space_of_features
from tacsim.gym.features import FeatureEncoder
from tacsim.gym.vector import TacsimVectorEnv
from tacsim.interface import Pose, Truth
from tacsim.models.policy import ActionAxis, PolicySpec
from tacsim.models.rig import TaskConfig
from tacsim.models.scene import Scene
from tacsim.models.text import printable_line
from tacsim.models.training import Training
from tacsim.tasks import GoalOutOfReach, make_task

POLICY, CURVE = "policy.onnx", "curve.json"  # in the folder of a run
Figures = Mapping[str, float]


class Learner(Protocol):
    """Learns in rounds."""

    rounds: int
    actor: PolicyNetwork

    def round(self, number: int, tell: Tell) -> dict[str, float]:
        """One round; what is to be told of it, `steps` (control steps of all environments) among it."""
        ...

    def state(self) -> dict[str, Any]:
        """All that the next round depends on, as tensors, numbers and texts; `actor` is the state of the actor."""
        ...

    def restore(self, state: Mapping[str, Any]) -> None: ...


def environments(training: Training) -> TacsimVectorEnv:
    """Those that a policy is trained in. Raises ConfigError, CannotOpen, IncompatibleRig, ValueError."""
    return make_vector_env(
        training.environments,
        training.task,
        training.rig,
        training.overrides,
        autoreset_mode=AutoresetMode.SAME_STEP,
        randomise=training.randomise,
        features=training.features,
        learning=False,  # a training file says its preset and its motion
    )


def begin(training: Training, folder: Path) -> RunFolder:
    """Makes the folder of a new run. Raises as `environments`, GoalOutOfReach for a goal that can be drawn and not be
    reached, and FileExistsError."""
    envs = environments(training)  # what cannot be made is told before there is a folder
    envs.close()
    config = load_with_task(training.rig, training.task, training.overrides).config
    assert config.task is not None
    _require_playable(training, [(each.task, each.scene, each.description) for each in envs.members[0].variants])
    task, encoder = make_task(config.task), FeatureEncoder(training.features, config.canonical)
    spec = PolicySpec(
        task=config.task.kind,
        period=config.period,
        features=training.features,
        inputs=encoder.inputs,
        axes=tuple(ActionAxis(arm=axis.arm, direction=axis.direction) for axis in task.axes),
        max_step=config.task.max_step,
        trained={"by": f"tacsim {version()}".strip(), "training": training.model_dump(mode="json")},
    )
    space: Any = space_of_features(encoder, config)
    return RunFolder.make(folder, training, spec, {key: box.shape for key, box in space.items()})


def _require_playable(training: Training, drawn: list[tuple[TaskConfig, Scene | None, str]]) -> None:
    """Raises ConfigError for a range with an end that cannot be, GoalOutOfReach for a goal that the body, before
    anything touches it, has no way to; of what is `drawn`, and of the limits, near which other seeds may draw."""
    limits = []
    for words in () if training.randomise is None else training.randomise.limits():
        at = "a limit: " + "; ".join(words)
        try:
            config = load_with_task(training.rig, training.task, [*training.overrides, *words]).config
        except ConfigError as error:
            raise ConfigError([*error.problems, Problem(Place("randomise"), "", at)]) from None
        assert config.task is not None
        limits.append((config.task, config.scene, at))
    for task, scene, told in [*drawn, *limits]:
        if scene is None or scene.body is None:
            continue
        height = float(bounding_size(scene.body.geometry)[2])
        poses = dict.fromkeys(scene.sensors, Pose())
        try:
            make_task(task).require_reachable(
                Truth(height, np.array([0.0, 0.0, height / 2]), np.zeros((1, 3), np.float32), poses)
            )
        except GoalOutOfReach as error:
            raise GoalOutOfReach(f"randomise: {told}: {error}") from None


def train(
    run: RunFolder,
    tell: Tell = lambda words, done, of: None,
    say: Callable[[Figures], None] = lambda figures: None,
    warn: Callable[[str], None] = lambda words: None,
) -> Path:
    """Goes on with a run to its end, and writes its policy there; returns the file.

    say: is told the figures of each round: its number `round`, those of the learner, `refused` (draws that could not
    begin an episode, and were drawn anew), and `seconds`. warn: is told which draws, and why, each once.
    Raises RunError, BadDraws for too many of those, and OSError for a disk that is full: the last checkpoint is still
    whole.
    """
    torch.set_num_threads(1)  # small networks; and sums have one order on any machine
    done, state, curve = run.last()
    envs = environments(run.settings.training)
    try:
        learner = _learner(envs, run)
        if done:
            with _fitting(run):
                learner.restore(state)
        told: set[str] = set()
        for number in range(done, learner.rounds):
            began, before = time.perf_counter(), len(_refused(envs))
            figures = learner.round(number, tell)
            refused = _refused(envs)
            for words in dict.fromkeys(refused):
                if words not in told:
                    warn(f"drawn anew: {words}")
            told.update(refused)
            count = float(len(refused) - before)
            curve.append({"round": number + 1, **figures, "refused": count, "seconds": time.perf_counter() - began})
            # before the checkpoint: a round that is kept is not told again
            write_whole(run.folder / CURVE, json.dumps(curve, indent=1).encode())
            run.keep(number, learner.state(), curve)
            say(curve[-1])
    finally:
        envs.close()
    path = run.folder / POLICY
    export_policy(run, path, tell)
    return path


def _refused(envs: TacsimVectorEnv) -> list[str]:
    return [words for env in envs.members for words in env.refused]


def export_policy(run: RunFolder, path: Path, tell: Tell = lambda words, done, of: None) -> float:
    """Writes the policy of a run, as far as it has come, with the range of what it observes in training's episodes;
    returns how far the file's actions are from the network's.

    Raises RunError without a checkpoint, ExportError, OSError.
    """
    done, state, curve = run.last()
    if not done:
        raise RunError(f"{run.folder} has no checkpoint: not one round of its training is done")
    actor = new_actor(run)
    with _fitting(run):
        actor.load_state_dict(state["actor"])
    steps = int(sum(row["steps"] for row in curve))
    trained = {**run.settings.spec.trained, "rounds": done, "steps": steps}
    spec = run.settings.spec.model_copy(update={"trained": trained})
    worst = export(actor, spec, run.settings.shapes, path)
    write_range(path, path, measure_range(path, tell=tell))
    return worst


def new_actor(run: RunFolder) -> PolicyNetwork:
    """The network of a run, before anything is learned."""
    settings = run.settings
    torch.manual_seed(settings.training.seed)
    cut = settings.training.algorithm == "ppo"
    return PolicyNetwork(settings.shapes, len(settings.spec.axes), settings.training.width, cut=cut)


@contextmanager
def _fitting(run: RunFolder) -> Iterator[None]:
    """Raises RunError where what is restored in the block is not of this run's network."""
    try:
        yield
    except (KeyError, RuntimeError, ValueError) as failure:
        words = printable_line(str(failure).splitlines()[0])
        raise RunError(f"{run.folder}: its checkpoint does not fit its settings: {words}") from None


def _learner(envs: TacsimVectorEnv, run: RunFolder) -> Learner:
    if run.settings.training.algorithm == "dagger":
        return Dagger(envs, run.settings.training, new_actor(run), run.folder)
    from robot.train.reinforce import Reinforce

    return Reinforce(envs, run.settings.training, new_actor(run), run.folder)

"""A training run: rounds of acting and learning, a checkpoint after each round, a policy file at the end.

A round depends only on the settings, its number and the state after the previous round. So a killed run continues from
its last checkpoint to the same result, bit for bit.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from gymnasium.vector import AutoresetMode

from robot.common.cluster import tacsim_version
from robot.common.whole_file import write_whole
from robot.open import load_with_task, make_sharded_env, make_vector_env
from robot.rig.sharded_env import Environments
from robot.train.curve_picture import write_curve_picture
from robot.train.dagger import Dagger
from robot.train.measure_range import measure_range, write_range
from robot.train.network import PolicyNetwork, export
from robot.train.run_folder import ReportProgress, RunError, RunFolder
from tacsim.config import ConfigError
from tacsim.config.document import Place, Problem
from tacsim.geometry.shapes import bounding_size
from tacsim.gym.encode import space_of_features
from tacsim.gym.features import FeatureEncoder
from tacsim.interface import Pose, Truth
from tacsim.models.policy import ActionAxis, ActionGrip, PolicySpec, Training
from tacsim.models.scene import Scene
from tacsim.models.task import TaskConfig
from tacsim.models.text import printable_line
from tacsim.tasks import Axis, GoalOutOfReach, make_task

POLICY, CURVE, CURVE_PICTURE = "policy.onnx", "curve.json", "curve.png"  # in the folder of a run
Figures = Mapping[str, float]


class Learner(Protocol):
    """A learning algorithm that works in rounds."""

    rounds: int
    actor: PolicyNetwork

    def round(self, number: int, report_progress: ReportProgress) -> dict[str, float]:
        """Runs one round. Returns its figures, with `steps`: control steps of all environments."""
        ...

    def state(self) -> dict[str, Any]:
        """All inputs of the next round, as tensors, numbers and texts; `actor` is the state of the actor."""
        ...

    def restore(self, state: Mapping[str, Any]) -> None: ...


def make_environments(training: Training, processes: int | None = 1, cluster: str | None = None) -> Environments:
    """Creates the environments of a training; `processes`, `cluster`: see `robot.make_sharded_env`; 1 without a
    cluster: in this process. Raises its errors."""
    alone = processes == 1 and cluster is None
    make = make_vector_env if alone else partial(make_sharded_env, processes=processes, cluster=cluster)
    return make(
        training.environments,
        training.task,
        training.rig,
        training.overrides,
        autoreset_mode=AutoresetMode.SAME_STEP,
        randomise=training.randomise,
        features=training.features,
        learning=False,  # a training file says its preset and its motion
    )


def begin_run(training: Training, folder: Path) -> RunFolder:
    """Creates the folder of a new run. Raises the errors of `make_environments`, GoalOutOfReach for a goal that can be
    drawn but not reached, and FileExistsError."""
    envs = make_environments(training)  # reports errors before the folder is created
    variants = envs.get_attr("variants")[0]
    envs.close()
    config = load_with_task(training.rig, training.task, training.overrides).config
    assert config.task is not None
    _require_playable(training, [(each.task, each.scene, each.description) for each in variants])
    task, encoder = make_task(config.task), FeatureEncoder(training.features, config.canonical)
    spec = PolicySpec(
        task=config.task.kind,
        period=config.period,
        features=training.features,
        inputs=encoder.inputs,
        axes=tuple(
            ActionAxis(arm=axis.arm, direction=axis.direction)
            if isinstance(axis, Axis)
            else ActionGrip(gripper=axis.gripper, min_force=axis.min_force, max_force=axis.max_force)
            for axis in task.axes
        ),
        max_step=config.task.max_step,
        trained={"by": f"tacsim {tacsim_version()}".strip(), "training": training.model_dump(mode="json")},
    )
    space: Any = space_of_features(encoder, config)
    return RunFolder.make(folder, training, spec, {key: box.shape for key, box in space.items()})


def _require_playable(training: Training, drawn: list[tuple[TaskConfig, Scene | None, str]]) -> None:
    """Raises ConfigError for a range with an invalid limit, GoalOutOfReach for a goal that the undeformed body cannot
    reach. Checks the draws in `drawn` and the limits, near which other seeds may draw."""
    limits = []
    for words in () if training.randomise is None else training.randomise.limits():
        at = "a limit: " + "; ".join(words)
        try:
            config = load_with_task(training.rig, training.task, [*training.overrides, *words]).config
        except ConfigError as error:
            raise ConfigError([*error.problems, Problem(Place("randomise"), "", at)]) from None
        assert config.task is not None
        limits.append((config.task, config.scene, at))
    for task, scene, reported in [*drawn, *limits]:
        if scene is None or scene.body is None:
            continue
        height = float(bounding_size(scene.body.geometry)[2])
        poses = dict.fromkeys(scene.sensors, Pose())
        try:
            make_task(task).require_reachable(
                Truth(height, np.array([0.0, 0.0, height / 2]), np.zeros((1, 3), np.float32), poses)
            )
        except GoalOutOfReach as error:
            raise GoalOutOfReach(f"randomise: {reported}: {error}") from None


def train(
    run: RunFolder,
    report_progress: ReportProgress = lambda words, done, of: None,
    report_result: Callable[[Figures], None] = lambda figures: None,
    warn: Callable[[str], None] = lambda words: None,
    tensorboard: bool = False,
    processes: int | None = 1,
    cluster: str | None = None,
) -> Path:
    """Continues a run to its end, writes its policy to its folder and returns the file.

    report_result: called with the figures of each round: its number `round`, those of the learner, `refused` (draws
    that could not begin an episode and were repeated), and `seconds`. warn: called once for each refused draw.
    tensorboard: the log of stable-baselines3 is written to `tensorboard/` in the run's folder.
    processes, cluster: of the environments; see `make_environments`. The result does not depend on them.
    Raises RunError, WorkerFailed, ClusterError, BadDraws for too many refused draws, and OSError if the disk is full:
    the last checkpoint remains complete.
    """
    torch.set_num_threads(1)  # small networks; sums have the same order on any machine
    done, state, curve = run.load_checkpoint()
    envs = make_environments(run.settings.training, processes, cluster)
    try:
        learner = _make_learner(envs, run, tensorboard)
        if done:
            with _checking_fit(run):
                learner.restore(state)
        reported: set[str] = set()
        for number in range(done, learner.rounds):
            began, before = time.perf_counter(), len(_refused_draws(envs))
            figures = learner.round(number, report_progress)
            refused = _refused_draws(envs)
            for words in dict.fromkeys(refused):
                if words not in reported:
                    warn(f"drawn again: {words}")
            reported.update(refused)
            count = float(len(refused) - before)
            curve.append({"round": number + 1, **figures, "refused": count, "seconds": time.perf_counter() - began})
            # before the checkpoint: a completed round is not reported again
            write_whole(run.folder / CURVE, json.dumps(curve, indent=1).encode())
            write_curve_picture(run.folder / CURVE_PICTURE, run.settings, curve)
            run.save_checkpoint(number, learner.state(), curve)
            report_result(curve[-1])
    finally:
        envs.close()
    path = run.folder / POLICY
    export_policy(run, path, report_progress)
    return path


def _refused_draws(envs: Environments) -> list[str]:
    return [words for refused in envs.get_attr("refused") for words in refused]


def export_policy(run: RunFolder, path: Path, report_progress: ReportProgress = lambda words, done, of: None) -> float:
    """Writes the policy of a run after its last round, with the range of its observations in training episodes. Returns
    the maximum difference of the file's actions from the network's.

    Raises RunError without a checkpoint, ExportError, OSError.
    """
    done, state, curve = run.load_checkpoint()
    if not done:
        raise RunError(f"{run.folder} has no checkpoint: no round of its training is complete")
    actor = new_actor(run)
    with _checking_fit(run):
        actor.load_state_dict(state["actor"])
    steps = int(sum(row["steps"] for row in curve))
    trained = {**run.settings.spec.trained, "rounds": done, "steps": steps}
    spec = run.settings.spec.model_copy(update={"trained": trained})
    max_difference = export(actor, spec, run.settings.shapes, path)
    write_range(path, path, measure_range(path, report_progress=report_progress))
    return max_difference


def new_actor(run: RunFolder) -> PolicyNetwork:
    """The initial network of a run."""
    settings = run.settings
    torch.manual_seed(settings.training.seed)
    clip = settings.training.algorithm == "ppo"
    return PolicyNetwork(settings.shapes, len(settings.spec.axes), settings.training.width, clip=clip)


@contextmanager
def _checking_fit(run: RunFolder) -> Iterator[None]:
    """Raises RunError if the state restored in the block does not fit the network of this run."""
    try:
        yield
    except (KeyError, RuntimeError, ValueError) as failure:
        words = printable_line(str(failure).splitlines()[0])
        raise RunError(f"{run.folder}: its checkpoint does not fit its settings: {words}") from None


def _make_learner(envs: Environments, run: RunFolder, tensorboard: bool) -> Learner:
    if run.settings.training.algorithm == "dagger":
        return Dagger(envs, run.settings.training, new_actor(run), run.folder)
    from robot.train.reinforce import Reinforce

    return Reinforce(envs, run.settings.training, new_actor(run), run.folder, tensorboard)

"""A set of episodes on a simulated rig: one policy; each episode has its own seed and randomisation."""

from __future__ import annotations

import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from robot.collect.workers import Piece, Seconds, SetError
from robot.common.code import CodeNotFound
from robot.deploy.control_loop import EpisodeFailed, EpisodeSetup, run_episode
from robot.deploy.policy import load_policy, require_fit
from robot.open import CannotOpen, load_with_task, open_rig
from tacsim.config import ConfigError, LoadedRig
from tacsim.interface import Action, GripperTarget, IncompatibleRig, Needs, Observation, Policy, Pose, Truth
from tacsim.models.quantity import Config
from tacsim.models.randomisation import Randomisation
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.record.episode import EpisodeMeta, Step
from tacsim.record.writer import Recorder
from tacsim.rig import Rig
from tacsim.tasks import GoalOutOfReach, Task, make_task
from tacsim.tasks.task import action_of_vector, vector_of_action

RANDOM, TEACHER = "random", "teacher"  # in addition to the policies of load_policy


class EpisodeSet(Config):
    """The settings that determine the episodes, together with their numbers."""

    kind: Literal["episodes"] = "episodes"
    rig: str
    task: str | None = None
    overrides: tuple[str, ...] = ()
    policy: str = "scripted"
    steps: Annotated[int, Field(ge=1)] | None = None  # None: the task's
    seed: Annotated[int, Field(ge=0)] = 0  # of the first episode; each next one adds 1
    randomise: Randomisation | None = None

    def load_episode_rig(self, index: int) -> LoadedRig:
        """The rig of an episode with its randomisation."""
        more: list[str] = []
        if self.randomise is not None:
            more = self.randomise.model_copy(update={"draws": index + 1}).draw_overrides()[index]
        return load_with_task(self.rig, self.task, [*self.overrides, *more])


@dataclass(frozen=True, slots=True)
class EpisodeJob:
    """Makes the recordings of an episode set."""

    settings: EpisodeSet
    count: int

    @property
    def pieces(self) -> int:
        return self.count

    def name(self, piece: int) -> str:
        return f"episode-{piece:05d}.mcap"

    def numbers(self, piece: int) -> range:
        return range(piece, piece + 1)

    def worker(self, folder: Path) -> EpisodeWorker:
        return EpisodeWorker(self)

    def check(self) -> None:
        """Checks the settings before anything is simulated. Raises SetError, ConfigError, PolicyNotFound,
        IncompatibleRig."""
        loaded = self.settings.load_episode_rig(0)
        if loaded.config.clock not in ("sim", "mujoco"):
            raise SetError(
                f"rig '{loaded.config.name}' is not simulated, so its episodes cannot run in several processes at "
                "once; record its episodes with tacsim run"
            )
        with open_rig(loaded) as rig:
            _load_policy_and_task(self.settings, loaded, rig, 0)


class EpisodeWorker:
    """Runs one episode after the other."""

    def __init__(self, job: EpisodeJob) -> None:
        self._settings = job.settings

    def piece(self, number: int) -> Piece:
        """The recording of an episode; a failed episode has no recording."""
        seconds = Seconds()
        began = time.perf_counter()
        failures: dict[int, str] = {}
        data = None
        try:
            data = self._record_episode(number)
        except (EpisodeFailed, GoalOutOfReach, SimulationDiverged, ConfigError, CodeNotFound, CannotOpen) as failure:
            failures[number] = f"{type(failure).__name__}: {failure}"
        seconds.add("episode", time.perf_counter() - began)
        return Piece(number, data, failures, int(data is not None), seconds.by_part)

    def _record_episode(self, number: int) -> bytes:
        default_steps = 40  # of an episode without a task
        settings, loaded = self._settings, self._settings.load_episode_rig(number)
        seed = settings.seed + number
        with tempfile.TemporaryDirectory(prefix="tacsim-collect-") as folder, ExitStack() as stack:
            path = Path(folder) / "episode.mcap"
            rig = stack.enter_context(open_rig(loaded))
            policy, task = _load_policy_and_task(settings, loaded, rig, number)
            canonical = loaded.config.canonical
            attached = {"rig.yaml": loaded.text.encode()}
            setup = EpisodeSetup(settings.policy, seed, attached, canonical, bool(loaded.config.record.body))
            recorders: list[Recorder] = []

            def record(meta: EpisodeMeta) -> Recorder:
                recorders.append(stack.enter_context(Recorder(path, meta, pitch=canonical.pitch)))
                return recorders[0]

            def wait(step: Step) -> None:
                recorders[0].flush()  # a simulation may be faster than the disk, and no step must be dropped

            steps = settings.steps or (default_steps if task is None else task.config.steps)
            episode = run_episode(rig, policy, task, steps, setup=setup, recorder=record, on_step=wait)
            recorders[0].close()
            if recorders[0].error is not None:
                raise OSError(f"episode {number} could not be recorded: {recorders[0].error}")
            if len(episode.steps) <= steps:
                raise KeyboardInterrupt  # `run_episode` ends normally on an interrupt; a partial episode is no result
            return path.read_bytes()


class RandomPolicy:
    """Draws, at each step, a motion along each free axis of the task, between minus and plus the largest step."""

    needs = Needs()

    def __init__(self, task: Task, seed: int) -> None:
        self._task, self._seed = task, seed
        self.reset()

    def reset(self) -> None:
        self._random = np.random.default_rng(self._seed)

    def __call__(self, observation: Observation) -> Action:
        vector: Any = self._random.uniform(-1.0, 1.0, len(self._task.axes))
        poses = {name: arm.pose for name, arm in observation.arms.items()}
        return action_of_vector(vector, self._task.axes, self._task.config.max_step, poses)


class TeacherPolicy:
    """The best action by the ground truth of a simulated rig (`Task.expert`), or where the task knows no rule, what
    its `teacher` does: as the policy `teacher` of `tacsim evaluate`. Each reset begins a new episode."""

    needs = Needs(truth=True)

    def __init__(self, rig: Rig, task: Task) -> None:
        self._rig, self._task = rig, task
        self.reset()

    def reset(self) -> None:
        self._start: Truth | None = None
        self._targets: dict[str, Pose] = {}
        self._grips: dict[str, GripperTarget] = {}
        self._teacher: Policy | None = None

    def __call__(self, observation: Observation) -> Action:
        truth, task = self._rig.truth(), self._task
        assert truth is not None  # the rig has promised it
        if self._start is None:
            self._start, self._targets = truth, {name: arm.pose for name, arm in observation.arms.items()}
        vector: Any = task.expert(truth, self._start)
        if vector is None:
            self._teacher = self._teacher or task.teacher()
            asked = self._teacher(observation)
            vector = vector_of_action(asked, task.axes, task.config.max_step, self._targets, self._grips)
        action = action_of_vector(vector, task.axes, task.config.max_step, self._targets)
        self._targets |= {name: pose for name, pose in action.tool.items() if pose is not None}
        self._grips |= {name: grip for name, grip in action.grippers.items() if grip is not None}
        return action


def _load_policy_and_task(settings: EpisodeSet, loaded: LoadedRig, rig: Rig, number: int) -> tuple[Policy, Task | None]:
    """The policy of an episode, and its task. Raises SetError, PolicyNotFound, IncompatibleRig."""
    config = loaded.config
    task = None if config.task is None else make_task(config.task)
    if settings.policy in (RANDOM, TEACHER):
        if task is None:
            raise SetError(
                f"policy '{settings.policy}' moves along a task's axes, and rig '{rig.name}' has no task: give one "
                "(--task)"
            )
        chosen = RandomPolicy(task, settings.seed + number) if settings.policy == RANDOM else TeacherPolicy(rig, task)
        policy: Policy = chosen
    else:
        policy = load_policy(settings.policy, task, rig.spec, config.canonical, (RANDOM, TEACHER))
    try:
        require_fit(rig.name, rig.spec, policy, settings.policy, task)
    except IncompatibleRig as unfit:
        raise SetError(str(unfit)) from None
    return policy, task

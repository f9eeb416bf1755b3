"""Episodes and motions by hand of a served rig, in the thread of the rig."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from robot.deploy.control_loop import EpisodeFailed, EpisodeSetup, run_episode
from robot.deploy.policy import describe_outside, load_policy, require_fit
from robot.serve.operated_policy import Mode, OperatedPolicy, make_operated_policy
from tacsim.config import LoadedRig
from tacsim.interface import Observation, RigSpec
from tacsim.record.episode import TRAINING_DISTANCE, EpisodeMeta, Step
from tacsim.record.writer import Recorder
from tacsim.rig import Rig
from tacsim.tasks import Task, make_task


@dataclass(frozen=True, slots=True)
class StartOptions:
    """How an episode starts."""

    mode: Mode = "policy"
    steps: int | None = None  # of the policy; None: the task's; without one, or in teleoperation, until stopped
    seed: int = 0
    record: bool = False


@dataclass(frozen=True, slots=True)
class Watcher:
    """What is called while the rig moves: with the policy before the reset, with each step, with each observation."""

    on_begin: Callable[[OperatedPolicy], None]
    on_step: Callable[[Step], None]
    on_observation: Callable[[Observation], None]
    must_stop: Callable[[], bool]


class Episodes:
    """Runs episodes of a loaded rig with a policy by name (`load_policy`)."""

    def __init__(self, loaded: LoadedRig, policy: str) -> None:
        self._loaded, self._policy = loaded, policy
        config = loaded.config
        self._task: Task | None = None if config.task is None else make_task(config.task)
        self._max_step = None if self._task is None else self._task.config.max_step
        self._is_live = config.clock == "wall"

    def require_fit(self, spec: RigSpec) -> None:
        """Raises IncompatibleRig, PolicyNotFound: before the rig is opened."""
        policy = load_policy(self._policy, self._task, spec, self._loaded.config.canonical)
        require_fit(self._loaded.config.name, spec, policy, self._policy, self._task)

    def run(self, rig: Rig, options: StartOptions, watcher: Watcher, folder: Path | None) -> tuple[str, bool]:
        """Resets the rig and runs an episode, recorded in `folder` (None: not). Returns how it ended, "" for well, and
        whether there is a recording with steps. Raises what a reset raises."""
        config = self._loaded.config
        policy = load_policy(self._policy, self._task, rig.spec, config.canonical)
        require_fit(rig.name, rig.spec, policy, self._policy, self._task)
        steps = options.steps
        if steps is None and self._task is not None and options.mode != "teleoperation":
            steps = self._task.config.steps
        operated = make_operated_policy(
            policy, options.mode, config.period, self._max_step, steps, is_live=self._is_live
        )
        watcher.on_begin(operated)
        attached = {"rig.yaml": self._loaded.text.encode()}
        setup = EpisodeSetup(self._policy, options.seed, attached, config.canonical, config.records_body)
        recorders: list[Recorder] = []
        with ExitStack() as stack:

            def record(meta: EpisodeMeta) -> Recorder:
                assert folder is not None
                folder.mkdir(parents=True)
                recorder = Recorder(folder / "episode.mcap", meta, pitch=config.canonical.pitch)
                recorders.append(stack.enter_context(recorder))
                return recorder

            try:
                run_episode(
                    rig, operated, self._task, None, setup=setup, recorder=None if folder is None else record,
                    on_step=watcher.on_step, watch=lambda step, observation, truth: watcher.on_observation(observation),
                    stop=lambda: operated.has_ended or watcher.must_stop(),
                )  # fmt: skip
                words = ""
            except EpisodeFailed as failure:
                words = str(failure)
        return words, any(recorder.written for recorder in recorders)

    def outside_training(self, policy: OperatedPolicy | None, step: Step) -> str:
        """A warning when the observation of this step is outside the range of a learned policy; else ""."""
        if policy is None or step.info.get(TRAINING_DISTANCE, 0.0) <= 1.0:
            return ""
        return f"policy '{self._policy}': {describe_outside(policy.inner)}"

    def drive(self, rig: Rig, watcher: Watcher) -> None:
        """Moves arms by hand from where they are, without reset, task or recording, until `must_stop` or `end`."""
        period = self._loaded.config.period
        operated = make_operated_policy(None, "teleoperation", period, self._max_step, None, is_live=self._is_live)
        watcher.on_begin(operated)
        try:
            observation = rig.observe()
            while not (operated.has_ended or watcher.must_stop()):
                watcher.on_observation(observation)
                observation, _ = rig.step(operated(observation))
        finally:
            rig.stop()

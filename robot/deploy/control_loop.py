"""The control loop: a policy on a rig, step by step, judged by a task and handed to a recorder."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from importlib import metadata
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robot.deploy.policy import require_fit, training_info
from tacsim.control.contact_signal import contact_signal
from tacsim.interface import Action, EndOfEpisode, Observation, Policy, Pose, Truth
from tacsim.models.sensor import CanonicalGrid
from tacsim.record.episode import Episode, EpisodeMeta, Step
from tacsim.record.step_info import MAX_DEPTH, MAX_FLOW, MAX_SLOPE, PACKAGES_LOST, TACTILE_DISTANCE
from tacsim.rig import Rig
from tacsim.tasks import GoalOutOfReach, Task, evaluate_outcome

MAX_PARTICLES = 5_000  # of a body go into a recorded step, at most
PACKAGES = ("tacsim", "numpy", "taichi", "opencv-contrib-python-headless", "gymnasium")


class EpisodeFailed(RuntimeError):
    """An error, the `__cause__`, ended an episode early. What was done is in `episode`; the arms are stopped."""

    def __init__(self, message: str, episode: Episode) -> None:
        super().__init__(message)
        self.episode = episode


class RecordingFailed(RuntimeError):
    """Nothing can be recorded any more, e.g. because the disk is full."""


class StepRecorder(Protocol):
    """What takes the steps of an episode and keeps them: tacsim.Recorder."""

    @property
    def error(self) -> Exception | None:
        """What ended the recording early."""
        ...

    @property
    def steps(self) -> Sequence[Step]:
        """Those that it keeps."""
        ...

    def write(self, step: Step) -> bool: ...
    def flush(self) -> bool: ...


@dataclass(frozen=True, slots=True)
class EpisodeSetup:
    """What the record says of an episode beyond what rig and task know."""

    policy: str = "policy"
    seed: int = 0
    attachments: Mapping[str, bytes] = field(default_factory=dict)
    canonical: CanonicalGrid = field(default_factory=CanonicalGrid)  # of the rig
    body: bool = False  # particles of a simulated body go into the record


def run_episode(
    rig: Rig,
    policy: Policy,
    task: Task | None,
    steps: int,
    *,
    setup: EpisodeSetup = EpisodeSetup(),
    recorder: Callable[[EpisodeMeta], StepRecorder] | None = None,
    on_step: Callable[[Step], None] | None = None,
    watch: Callable[[Step, Observation, Truth | None], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Episode:
    """Resets rig and policy, then runs exactly `steps` control steps; fewer only when a recording is over, `stop` says
    so, or on Ctrl-C. The episode's step 0 is the state after reset. Where the rig knows the truth of the body, its task
    judges by that; where all that it takes is felt, `Step.info` has the distance by touch alone (`felt_distance`), too.
    Of a learned policy it has `training_distance`: above 1 the observation lies outside the range of its training.

    With a recorder the steps of the episode are those in its file, read when they are asked for: however long it is,
    it takes no memory. Without one they are kept in memory, with their pictures.

    Args:
        recorder: opens the recording, once the references without contact are there (they are attached).
        on_step: called after each step, e.g. for a progress bar.
        watch: the same, with what was observed and what only a simulation knows, e.g. for a viewer.
        stop: asked before each step.

    Raises:
        IncompatibleRig: the rig lacks what policy or task needs; nothing has moved.
        GoalOutOfReach: no policy could bring this body to the task's goal; nothing but the reset was done.
        EpisodeFailed: policy, rig or recorder failed; the arms are stopped, the episode is kept in the exception.
    """
    if steps < 0:
        raise ValueError(f"steps must be 0 or more, got {steps}")
    require_fit(rig.name, rig.spec, policy, setup.policy, task)
    started = time.perf_counter()
    observation = rig.reset(setup.seed)
    start = rig.truth()
    if task is not None and start is not None:
        _require_reachable(rig, task, start)
    rig.packages()  # those of before are not of this episode
    log, thinking = _Log(rig, task, start, setup, recorder), False

    def keep(
        observation: Observation, action: Action | None, sent: Mapping[str, Pose | None], noted: Mapping[str, float]
    ) -> None:
        step, truth = log.keep(observation, action, sent, time.perf_counter() - started, noted)
        if on_step is not None:
            on_step(step)
        if watch is not None:
            watch(step, observation, truth)

    try:
        policy.reset()
        keep(observation, None, {}, {})
        while log.count <= steps and not stop():
            started = time.perf_counter()
            thinking = True
            action = policy(observation)
            thinking = False
            noted = training_info(policy)
            observation, sent = rig.step(action)
            keep(observation, action, sent, noted)
    except (EndOfEpisode, KeyboardInterrupt):
        pass
    except (Exception, SystemExit) as failure:  # a policy may call sys.exit
        done = max(log.count - 1, 0)
        why = f"{type(failure).__name__}: {failure}"
        if thinking:
            why = f"policy '{setup.policy}' raised {why}; the arms hold. Mend it, and try it in simulation"
        raise EpisodeFailed(f"episode ended after {done} of {steps} steps: {why}", log.episode) from failure
    finally:
        rig.stop()
        log.flush()
    return log.episode


def _require_reachable(rig: Rig, task: Task, start: Truth) -> None:
    try:
        task.require_reachable(start)
    except GoalOutOfReach:
        rig.stop()
        raise


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that make the numbers, without importing them."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            found[package] = metadata.version(package)
    return found


def _meta(rig: Rig, task: Task | None, setup: EpisodeSetup) -> EpisodeMeta:
    from tacsim.record.images import reference_attachments

    return EpisodeMeta(
        rig=rig.name,
        task=None if task is None else task.config.kind,
        policy=setup.policy,
        seed=setup.seed,
        spec=rig.spec,
        versions=versions(),
        attachments={**setup.attachments, **reference_attachments(rig.references)},
        goal=None if task is None else task.goal,
        started=datetime.now().astimezone(),
        wall_offset=time.time_ns() - round(1e9 * rig.now()),
    )


def _surfaces(observation: Observation) -> dict[str, float]:
    """What is known of the gels, each in three numbers."""
    found = {}
    for name, touch in observation.tactile.items():
        if touch.height is not None:
            found[f"{MAX_DEPTH}{name}"] = float(touch.height.max())
        if touch.gradient is not None:
            found[f"{MAX_SLOPE}{name}"] = float(np.linalg.norm(touch.gradient, axis=2).max())
        if touch.flow is not None:
            found[f"{MAX_FLOW}{name}"] = float(np.linalg.norm(touch.flow, axis=2).max())
    return found


class _Log:
    """The steps of a running episode, judged, and kept: in its recording, or else in memory."""

    def __init__(
        self,
        rig: Rig,
        task: Task | None,
        start: Truth | None,
        setup: EpisodeSetup,
        recorder: Callable[[EpisodeMeta], StepRecorder] | None,
    ) -> None:
        meta = _meta(rig, task, setup)
        self._rig, self._task, self._start, self._body = rig, task, start, setup.body
        self._recorder = None if recorder is None else recorder(meta)
        can_feel = task is not None and not task.touch_needs.missing(rig.spec)
        self._feel = task.estimator(setup.canonical) if task is not None and can_feel else None
        self._kept: list[Step] = []
        self.episode = Episode(meta, self._kept if self._recorder is None else self._recorder.steps)
        self.count = 0

    def keep(
        self,
        observation: Observation,
        action: Action | None,
        sent: Mapping[str, Pose | None],
        seconds: float,
        noted: Mapping[str, float],
    ) -> tuple[Step, Truth | None]:
        """The step of what the rig has delivered, which took so many `seconds`; and the truth that judged it. `noted`:
        numbers of the policy for `Step.info`. Raises RecordingFailed."""
        truth = self._rig.truth()
        step = self._step(truth, observation, action, sent, seconds)
        step = replace(step, info={**step.info, **noted}) if noted else step
        self.count += 1
        if self._recorder is None:
            self._kept.append(step)
        elif not self._recorder.write(step):
            self.episode.dropped += 1
            if self._recorder.error is not None:
                raise RecordingFailed(f"the recording ended early: {self._recorder.error}")
        return step, truth

    def flush(self) -> None:
        """Waits until the recording has all that was kept."""
        if self._recorder is not None:
            self._recorder.flush()

    def _step(
        self,
        truth: Truth | None,
        observation: Observation,
        action: Action | None,
        sent: Mapping[str, Pose | None],
        seconds: float,
    ) -> Step:
        info = {f"contact_signal_{name}": contact_signal(touch) for name, touch in observation.tactile.items()}
        info |= _surfaces(observation)
        info |= self._rig.diagnostics()
        packages = self._rig.packages()
        info |= {f"{PACKAGES_LOST}{name}": float(each.lost) for name, each in packages.items()}
        distance = None if self._feel is None else self._feel(observation)
        if distance is not None:
            info[TACTILE_DISTANCE] = distance
        outcome = None
        if truth is not None and self._start is not None:
            moved = truth.position - self._start.position
            info |= {"body_height": truth.height, "body_x": float(moved[0]), "body_y": float(moved[1])}
            outcome = None if self._task is None else evaluate_outcome(self._task, truth, self._start)
        return Step(
            index=self.count,
            time=observation.time,
            frames=self._rig.frames,
            arms=observation.arms,
            action=action,
            sent=sent,
            reward=None if outcome is None else outcome.reward,
            distance=None if outcome is None else outcome.distance,
            info=info,
            seconds=seconds,
            packages=packages,
            body=_thinned(truth.points) if self._body and truth is not None else None,
        )


def _thinned(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """(m, 3) every so many of points (n, 3), MAX_PARTICLES at most."""
    return points[:: -(-len(points) // MAX_PARTICLES) or 1].copy()

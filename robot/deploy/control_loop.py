"""The control loop: runs a policy on a rig, judges each step by a task and records it."""

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

from robot.deploy.policy import require_fit, reset_policy, training_info
from tacsim.control import contact_signal
from tacsim.interface import Action, EndOfEpisode, Observation, Policy, Pose, Truth
from tacsim.limits import ActionError
from tacsim.models.sensor import CanonicalGrid
from tacsim.record.episode import (
    MAX_DEPTH,
    MAX_FLOW,
    MAX_SLOPE,
    PACKAGES_LOST,
    TACTILE_DISTANCE,
    Episode,
    EpisodeMeta,
    Step,
)
from tacsim.rig import Rig
from tacsim.tasks import GoalOutOfReach, Task, evaluate_outcome

MAX_PARTICLES = 5_000  # of a body in a recorded step
PACKAGES = ("tacsim", "numpy", "taichi", "opencv-contrib-python-headless", "gymnasium")


class EpisodeFailed(RuntimeError):
    """An error, the `__cause__`, ended an episode early. `episode` has the steps done; the arms are stopped.
    `by_policy`: the policy raised it, or asked for an action that is none."""

    def __init__(self, message: str, episode: Episode, *, by_policy: bool = False) -> None:
        super().__init__(message)
        self.episode, self.by_policy = episode, by_policy


class RecordingFailed(RuntimeError):
    """The recording cannot continue, e.g. because the disk is full."""


class StepRecorder(Protocol):
    """Protocol of a recorder of steps: tacsim.Recorder."""

    @property
    def error(self) -> Exception | None:
        """Error that ended the recording early; None without one."""
        ...

    @property
    def steps(self) -> Sequence[Step]:
        """The recorded steps."""
        ...

    def write(self, step: Step) -> bool: ...
    def flush(self) -> bool: ...


@dataclass(frozen=True, slots=True)
class EpisodeSetup:
    """Data of an episode for its record, beyond those of rig and task."""

    policy: str = "policy"
    seed: int = 0
    attachments: Mapping[str, bytes] = field(default_factory=dict)
    canonical: CanonicalGrid = field(default_factory=CanonicalGrid)  # of the rig
    body: bool = False  # record the particles of a simulated body


def run_episode(
    rig: Rig,
    policy: Policy,
    task: Task | None,
    steps: int | None,
    *,
    setup: EpisodeSetup = EpisodeSetup(),
    recorder: Callable[[EpisodeMeta], StepRecorder] | None = None,
    on_step: Callable[[Step], None] | None = None,
    watch: Callable[[Step, Observation, Truth | None], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Episode:
    """Resets rig and policy, then runs exactly `steps` control steps (None: until it is stopped); fewer only at the end
    of a replayed recording, if `stop` returns True, or on Ctrl-C. Step 0 of the episode is the state after reset. If
    the rig knows the truth of the body, its task judges by that. If the sensors measure enough, `Step.info` also has
    the distance estimated from touch alone (`felt_distance`). For a learned policy it has `training_distance`: above 1
    the observation is outside the range of its training.

    With a recorder the steps of the episode are read from its file on access, so a long episode needs no memory.
    Without one they are stored in memory, with their pictures.

    Args:
        recorder: opens the recording after the reference pictures without contact were taken (they are attached).
        on_step: called after each step, e.g. for a progress bar.
        watch: called after each step with the observation and the truth of a simulation, e.g. for a viewer.
        stop: called before each step.

    Raises:
        IncompatibleRig: the rig lacks something that policy or task needs; nothing has moved.
        GoalOutOfReach: no policy could bring this body to the task's goal; only the reset was done. Also the errors of
            `rig.reset`.
        EpisodeFailed: policy, rig or recorder failed; the arms are stopped, the exception has the episode.
    """
    if steps is not None and steps < 0:
        raise ValueError(f"steps must be 0 or more, got {steps}")
    require_fit(rig.name, rig.spec, policy, setup.policy, task)
    started = time.perf_counter()
    observation = rig.reset(setup.seed)
    start = rig.truth()
    if task is not None and start is not None:
        _require_reachable(rig, task, start)
    rig.packages()  # drops those from before this episode
    log, is_in_policy = _EpisodeLog(rig, task, start, setup, recorder), False

    def add_step(
        observation: Observation,
        action: Action | None,
        sent: Mapping[str, Pose | None],
        policy_info: Mapping[str, float],
    ) -> None:
        step, truth = log.add_step(observation, action, sent, time.perf_counter() - started, policy_info)
        if on_step is not None:
            on_step(step)
        if watch is not None:
            watch(step, observation, truth)

    try:
        is_in_policy = True
        reset_policy(policy, task)
        is_in_policy = False
        add_step(observation, None, {}, {})
        while (steps is None or log.count <= steps) and not stop():
            started = time.perf_counter()
            is_in_policy = True
            action = policy(observation)
            is_in_policy = False
            policy_info = training_info(policy)
            observation, sent = rig.step(action)
            add_step(observation, action, sent, policy_info)
    except (EndOfEpisode, KeyboardInterrupt):
        pass
    except (Exception, SystemExit) as failure:  # a policy may call sys.exit
        steps_done = max(log.count - 1, 0)
        reason = f"{type(failure).__name__}: {failure}"
        if is_in_policy:
            reason = f"policy '{setup.policy}' raised {reason}; the arms hold. Correct it, and test it in simulation"
        count = f"{steps_done} steps" if steps is None else f"{steps_done} of {steps} steps"
        by_policy = is_in_policy or isinstance(failure, ActionError)
        raise EpisodeFailed(f"episode ended after {count}: {reason}", log.episode, by_policy=by_policy) from failure
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
    """Versions of Python and of the packages that affect results, without importing them."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            found[package] = metadata.version(package)
    return found


def _make_meta(rig: Rig, task: Task | None, setup: EpisodeSetup) -> EpisodeMeta:
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


def _surface_extremes(observation: Observation) -> dict[str, float]:
    """Maximum depth, slope and flow of each gel, as far as observed."""
    found = {}
    for name, touch in observation.tactile.items():
        if touch.height is not None:
            found[f"{MAX_DEPTH}{name}"] = float(touch.height.max())
        if touch.gradient is not None:
            found[f"{MAX_SLOPE}{name}"] = float(np.linalg.norm(touch.gradient, axis=2).max())
        if touch.flow is not None:
            found[f"{MAX_FLOW}{name}"] = float(np.linalg.norm(touch.flow, axis=2).max())
    return found


class _EpisodeLog:
    """The judged steps of a running episode, stored in its recording, or in memory without one."""

    def __init__(
        self,
        rig: Rig,
        task: Task | None,
        start: Truth | None,
        setup: EpisodeSetup,
        recorder: Callable[[EpisodeMeta], StepRecorder] | None,
    ) -> None:
        meta = _make_meta(rig, task, setup)
        self._rig, self._task, self._start, self._has_body = rig, task, start, setup.body
        self._recorder = None if recorder is None else recorder(meta)
        has_tactile_estimate = task is not None and not task.touch_needs.missing(rig.spec)
        self._tactile_estimator = task.estimator(setup.canonical) if task is not None and has_tactile_estimate else None
        self._steps: list[Step] = []
        self.episode = Episode(meta, self._steps if self._recorder is None else self._recorder.steps)
        self.count = 0

    def add_step(
        self,
        observation: Observation,
        action: Action | None,
        sent: Mapping[str, Pose | None],
        seconds: float,
        policy_info: Mapping[str, float],
    ) -> tuple[Step, Truth | None]:
        """Adds the step of the rig's newest state, which took `seconds` [s]. Returns the step and the truth that judged
        it. `policy_info`: numbers of the policy for `Step.info`. Raises RecordingFailed."""
        truth = self._rig.truth()
        step = self._make_step(truth, observation, action, sent, seconds)
        step = replace(step, info={**step.info, **policy_info}) if policy_info else step
        self.count += 1
        if self._recorder is None:
            self._steps.append(step)
        elif not self._recorder.write(step):
            self.episode.dropped += 1
            if self._recorder.error is not None:
                raise RecordingFailed(f"the recording ended early: {self._recorder.error}")
        return step, truth

    def flush(self) -> None:
        """Waits until the recording has written all steps."""
        if self._recorder is not None:
            self._recorder.flush()

    def _make_step(
        self,
        truth: Truth | None,
        observation: Observation,
        action: Action | None,
        sent: Mapping[str, Pose | None],
        seconds: float,
    ) -> Step:
        info = {f"contact_signal_{name}": contact_signal(touch) for name, touch in observation.tactile.items()}
        info |= _surface_extremes(observation)
        info |= self._rig.diagnostics()
        packages = self._rig.packages()
        info |= {f"{PACKAGES_LOST}{name}": float(each.lost) for name, each in packages.items()}
        distance = None if self._tactile_estimator is None else self._tactile_estimator(observation)
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
            grippers=observation.grippers,
            sent_grippers={} if action is None else self._rig.sent_grippers,
            body=_subsample(truth.points) if self._has_body and truth is not None else None,
        )


def _subsample(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Every k-th of the points (n, 3): (m, 3), at most MAX_PARTICLES."""
    return points[:: -(-len(points) // MAX_PARTICLES) or 1].copy()

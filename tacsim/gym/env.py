"""Gymnasium environments: Env = Rig + Task. See tacsim.gym for how Gymnasium finds them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded

from tacsim.control import NoTouch, ObjectDropped
from tacsim.gym import encode
from tacsim.gym.features import FeatureEncoder
from tacsim.interface import Float32, GripperTarget, Image, Needs, Observation, Policy, Pose, Truth
from tacsim.limits import LimitExceeded
from tacsim.models.rig import RigConfig
from tacsim.models.scene import Scene
from tacsim.models.task import TaskConfig
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.rig import Rig
from tacsim.sim.scene_world import SimulatedScene
from tacsim.tasks import BadDraws, GoalOutOfReach, make_task
from tacsim.tasks.task import Effort, Task, action_of_vector, evaluate_outcome, vector_of_action

Result = tuple[encode.FlatObservation, float, bool, bool, dict[str, Any]]  # of a step
RESET_ERRORS = (GoalOutOfReach, NoTouch, SimulationDiverged, ObjectDropped)  # with this draw
StepError = LimitExceeded | SimulationDiverged | ObjectDropped  # that ends an episode
STEP_ERRORS = (LimitExceeded, SimulationDiverged, ObjectDropped)


def copy_reset_options(options: Mapping[str, Any] | None) -> dict[str, Any]:
    """A copy. Raises ValueError for what is no mapping."""
    if not isinstance(options, Mapping | None):
        raise ValueError(f"options of a reset are a dict, got {options!r}")
    return dict(options or {})


@dataclass(frozen=True, slots=True)
class Variant:
    """What differs from one episode to the next: the goal, what is between the gels, and how sensors see it."""

    task: TaskConfig
    scene: Scene
    rig: RigConfig | None  # light and noise of its sensors, errors and delays; None: as the environment's
    description: str = ""  # in words, for the record


class TacsimEnv(gymnasium.Env[encode.FlatObservation, Float32]):
    """A rig with a task. Observations: `tacsim.gym.encode.flatten_observation`, or the features of an encoder. Actions:
    Box(-1, 1), one component for each free axis of the task, in units of its max_step from the last commanded pose.

    An episode terminates only when a limit of an arm, or the task's force_limit, is exceeded (info["limit"] says
    which), or a rigid object is dropped (info["dropped"] says how). Its last reward then stands for all steps that are
    left too, each at most -1: no end is better than going on. It is truncated after the task's steps, or when the
    simulation diverges (info["diverged"] says why; the observation is the last good one).

    info: distance [m], is_success, score, body_height [m], peak_force [N] and work [J] of the arms since reset, the
    preset of a simulated scene and its known force error (`preset`, `preset_error`), the rig's diagnostics, and at the
    end what else the task measures; with variants also `variant`, the
    number of the one that is played, and at reset `drawn`, what it consists of, and `refused`: draws before it that
    could not begin, and why.

    Args:
        space: of the observations; None: the rig is reset once to learn the shapes.
        encoder: of the features that a learned policy sees; None: the environment shows all that there is.
        variants: each reset draws one of them, from its seed; none: the rig and the task stay as they are.
        scene_world: what the rig simulates, where a reset may exchange its scene.
        wear: gives sensors and arms of the rig what `Variant.rig` says of them.

    Raises IncompatibleRig when the rig lacks what the task needs.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        rig: Rig,
        task: Task,
        render_mode: str | None = None,
        *,
        space: gymnasium.Space[encode.FlatObservation] | None = None,
        encoder: FeatureEncoder | None = None,
        variants: Sequence[Variant] = (),
        scene_world: SimulatedScene | None = None,
        apply_variation: Callable[[RigConfig | None], None] = lambda config: None,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        rig.require(Needs(truth=True), "an environment")
        rig.require(task.needs, f"task '{task.config.kind}'")
        self._view = encode.FlatView() if encoder is None else encoder
        rig.require(self._view.needs, "a choice of features")
        self.rig, self.task, self.render_mode = rig, task, render_mode
        self._variants, self._scene_world, self._apply_variation = tuple(variants), scene_world, apply_variation
        self._played: int | None = None  # the variant
        self._applied_variation: RigConfig | None = (
            None  # of which sensors and arms are now; None: of the environment's rig
        )
        self.next_variant: int | None = None  # that the next reset plays, if it can begin; None: a drawn one
        self.refused: list[str] = []  # draws that could not begin, and why, of all resets
        if space is None:
            self._begin_episode(seed=0)
            space = encode.space_of(self._flat)
        self.observation_space = space
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (len(task.axes),), np.float32)
        self.phase: Literal["new", "running", "over"] = "new"  # of the episode; over: terminated or truncated
        self._teacher: Policy | None = None  # of this episode, once it is asked
        self._sent: Mapping[str, Pose | None] = {}  # by the last begin_step
        self._failure: StepError | None = None
        self._done: Result | None = None  # a step that is done, but not taken yet

    @property
    def variants(self) -> tuple[Variant, ...]:
        """Those that resets draw from."""
        return self._variants

    @property
    def observation(self) -> Observation:
        """The last one, as policies see it that are not learned."""
        return self._observation

    @property
    def scene(self) -> Scene | None:
        """Of the next reset, if none is chosen or drawn for it; None where it cannot be exchanged."""
        return None if self._scene_world is None else self._scene_world.scene

    # ------------------------------------------------------------------ reset

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[encode.FlatObservation, dict[str, Any]]:
        """The same seed gives the same episode. A drawn variant that cannot begin (a goal out of reach, no gentle
        contact, a simulation that diverges) is drawn again.

        options: `variant`, the number of one of the environment's variants, in place of a drawn one; or `task`
        (SqueezeConfig, RepositionConfig) and `scene` (Scene), which hold until others are given. Raises ValueError for
        others, for what cannot change between episodes, for a goal that no policy can reach (GoalOutOfReach), and for
        too many bad draws (BadDraws).
        """
        max_refused = 8  # draws in a row
        super().reset(seed=seed)
        chosen, refused = copy_reset_options(options), list[str]()
        while not self._try_begin_episode(chosen, refused):
            if len(refused) == max_refused:
                raise BadDraws(
                    f"{max_refused} draws in a row cannot begin an episode, the last with {refused[-1]}; narrow "
                    "the distributions"
                )
        info = self._evaluate_state()[1]
        if self._played is not None:
            info["drawn"] = self._variants[self._played].description
        if refused:
            info["refused"] = "\n".join(refused)
        return self._flat, info

    def _try_begin_episode(self, options: dict[str, Any], refused: list[str]) -> bool:
        """Chooses and begins an episode; False, and why in `refused`, for a drawn one that cannot begin."""
        self._choose_scene_and_task(options)
        try:
            self._begin_episode(seed=int(self.np_random.integers(2**31)))
        except RESET_ERRORS as failure:
            if self._played is None or options:
                raise
            refused.append(f"{self._variants[self._played].description}: {failure}")
            self.refused.append(refused[-1])
            return False
        return True

    def _choose_scene_and_task(self, options: dict[str, Any]) -> None:
        """The task and the scene of the next episode."""
        unknown = sorted(set(options) - {"variant", "task", "scene"})
        if unknown:
            raise ValueError(f"reset knows the options variant, task and scene, got {unknown}")
        chosen, played, variation = options, None, None
        if self._variants and not {"task", "scene"} & set(options):
            number, self.next_variant = options.get("variant", self.next_variant), None
            played = int(self.np_random.integers(len(self._variants))) if number is None else number
            if not (isinstance(played, int | np.integer) and 0 <= played < len(self._variants)):
                raise ValueError(f"this environment has variants 0 to {len(self._variants) - 1}, got {number}")
            chosen = {"task": self._variants[played].task, "scene": self._variants[played].scene}
            variation = self._variants[played].rig
        elif "variant" in options:
            raise ValueError("options: give a variant (of an environment that has some), or a task and a scene")
        for name, kind in (("task", TaskConfig), ("scene", Scene)):
            if name in chosen and not isinstance(chosen[name], kind):
                raise ValueError(f"options: the {name} is a tacsim {kind.__name__}, got {chosen[name]!r}")
        if "task" in chosen:
            require_compatible_task(self.task.config, chosen["task"])
        if variation is not self._applied_variation:
            self._apply_variation(variation)
            self._applied_variation = variation
        if "scene" in chosen:
            if self._scene_world is None:
                raise ValueError(f"rig '{self.rig.name}' has but one scene; make its environment by robot.make_env")
            self._scene_world.set_scene(chosen["scene"])
        if "task" in chosen:
            self.task = make_task(chosen["task"])
        self._played = played

    def _begin_episode(self, seed: int) -> None:
        self.phase, self._failure, self._done = "new", None, None
        observation = self.rig.reset(seed)
        self._targets: dict[str, Pose] = {name: arm.pose for name, arm in observation.arms.items()}  # last sent there
        self._grips: dict[str, GripperTarget] = {}  # last sent
        self._truth_at_start = self._require_truth()
        self.task.require_reachable(self._truth_at_start)
        self._effort = Effort(observation.arms)
        self._count, self.phase = 0, "running"
        self._observation, self._teacher = observation, None
        self._flat: encode.FlatObservation = self._view.begin(observation, self.task.goal)

    def _require_truth(self) -> Truth:
        truth = self.rig.truth()
        if truth is None:
            raise RuntimeError(f"rig '{self.rig.name}' promises ground truth in its spec, but delivers none")
        return truth

    # ------------------------------------------------------------------- step

    def step(self, action: Float32) -> Result:
        """One control period. Raises ActionError for an action outside the space, ResetNeeded after the end."""
        if self._done is None:
            self.begin_step(action)
            if self.commanded:
                try:
                    self.rig.tick()
                except STEP_ERRORS as failure:
                    self.fail(failure)
            self.end_step()
        assert self._done is not None
        result, self._done = self._done, None
        return result

    def begin_step(self, action: Float32) -> None:
        """The first part of a step: commands the arms. The rig's clock ticks next, if the arms are `commanded`; then
        `end_step`. Raises as `step`."""
        if self.phase != "running":
            raise ResetNeeded("call reset() before step(): no episode is running")
        requested = action_of_vector(action, self.task.axes, self.task.config.max_step, self._targets)
        self._failure = None
        try:
            self._sent = self.rig.command(requested)
        except LimitExceeded as failure:
            self.fail(failure)

    @property
    def commanded(self) -> bool:
        """The arms have taken what the last `begin_step` asked."""
        return self._failure is None

    def fail(self, failure: StepError) -> None:
        """The step that was begun comes to this end, and the episode with it."""
        self._failure = failure

    def end_step(self) -> None:
        """The last part of a step: observes and judges. The next call of `step` returns it."""
        self._count += 1
        if self._failure is None:
            try:
                observation = self.rig.observe()
            except LimitExceeded as failure:
                self.fail(failure)
        if self._failure is not None:
            self.phase = "over"
            exceeded = not isinstance(self._failure, SimulationDiverged)
            word = "dropped" if isinstance(self._failure, ObjectDropped) else "limit" if exceeded else "diverged"
            reward, info = self._evaluate_state()
            flat = {key: value.copy() for key, value in self._flat.items()}
            info |= {word: str(self._failure)}
            info["is_success"] = info["is_success"] and not exceeded
            self._done = (
                flat,
                self._reward_for_remaining_steps(reward) if exceeded else reward,
                exceeded,
                not exceeded,
                info,
            )
            return
        self._targets |= {name: pose for name, pose in self._sent.items() if pose is not None}
        self._grips |= {name: grip for name, grip in self.rig.sent_grippers.items() if grip is not None}
        self._observation = observation
        self._effort.add(observation.arms)
        self._flat = self._view(observation)
        max_force, peak = self.task.config.force_limit, self._effort.peak
        failed = max_force is not None and peak > max_force
        truncated = not failed and self._count >= self.task.config.steps
        if failed or truncated:
            self.phase = "over"
        reward, info = self._evaluate_state()
        if failed:
            info |= {"limit": f"a normal force of {peak:.2f} N, beyond the task's force_limit of {max_force:g} N"}
            info["is_success"], reward = False, self._reward_for_remaining_steps(reward)
        self._done = self._flat, reward, failed, truncated, info

    def _reward_for_remaining_steps(self, reward: float) -> float:
        return reward + (self.task.config.steps - self._count) * min(reward, -1.0)

    def _evaluate_state(self) -> tuple[float, dict[str, Any]]:
        truth = self._require_truth()
        outcome = evaluate_outcome(self.task, truth, self._truth_at_start)
        info: dict[str, Any] = {
            "distance": outcome.distance,
            "is_success": outcome.success,
            "score": outcome.score,
            "body_height": truth.height,
            "peak_force": self._effort.peak,
            "work": self._effort.work,
        }
        scene = self.scene
        if scene is not None:
            info |= {"preset": scene.preset, "preset_error": scene.preset_error}
        if self._played is not None:
            info["variant"] = self._played
        if self.phase == "over":
            info |= self.task.measures(truth, self._truth_at_start)
        return outcome.reward, info | dict(self.rig.diagnostics())

    def expert(self, knows_truth: bool = True) -> Float32:
        """What a teacher does here: by the truth; where the task has no such rule, or not `knows_truth`, its `teacher`.

        Zeros where no episode is running.
        """
        if self.phase != "running":
            return np.zeros(len(self.task.axes), np.float32)
        best = self.task.expert(self._require_truth(), self._truth_at_start) if knows_truth else None
        if best is not None:
            return np.asarray(best, np.float32)
        if self._teacher is None:
            self._teacher = self.task.teacher()
        return self.policy_action(self._teacher)

    def policy_action(self, policy: Policy) -> Float32:
        """What `policy` does here, as an action of this environment. A policy with a memory must be asked in every step
        of the episode, and reset before."""
        action = policy(self._observation)
        return vector_of_action(action, self.task.axes, self.task.config.max_step, self._targets, self._grips)

    def render(self) -> Image | None:
        """The native pictures of all sensors side by side, (H, W, 3) uint8 RGB, in the order of the rig; smaller ones
        are padded with black below."""
        if self.render_mode is None:
            return None
        if not self.rig.frames:
            raise ResetNeeded("call reset() before render(): nothing was seen yet")
        images = [frame.image for frame in self.rig.frames.values()]
        rows = max(image.shape[0] for image in images)
        padded = [np.pad(image, ((0, rows - image.shape[0]), (0, 0), (0, 0))) for image in images]
        return np.concatenate(padded, axis=1)

    def close(self) -> None:
        self.rig.close()


def require_compatible_task(task: TaskConfig, other: TaskConfig) -> None:
    """Raises ValueError where an environment cannot go from one task to the other: only its goal, its steps and how it
    is judged may change."""
    for what in ("kind", "touch_force", "placement", "loads"):
        now, new = getattr(task, what, None), getattr(other, what, None)
        if now != new:
            raise ValueError(f"a new task must keep {what} of the environment's: {now}, got {new}")

"""Relief: press dents of given depths into the body, with a gel that is narrower than it."""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tacsim.geometry import shapes
from tacsim.interface import Action, FloatArray, Needs, Observation, Policy, Pose, Truth
from tacsim.models.task import ReliefConfig
from tacsim.tasks.task import Axis, GoalOutOfReach, Task
from tacsim.tasks.tuning import (
    FIRST_EXCESS,
    MAX_PRESSES,
    MIN_RELIEF_FORCE,
    ONLY_EXCESS,
    RELIEF_CLEARANCE,
    RELIEF_TOLERANCE,
    TOUCH_STEP,
)

Motion = Generator[Action, Observation, Observation]  # takes and returns the last observation


@dataclass(frozen=True)
class Relief(Task):
    """distance = rms over the dents of (depth - goal); actions move the upper sensor along world x and z."""

    config: ReliefConfig

    @property
    def axes(self) -> tuple[Axis, ...]:
        return (Axis("upper", (1.0, 0.0, 0.0)), Axis("upper", (0.0, 0.0, 1.0)))

    @property
    def goal(self) -> tuple[float, ...]:
        return self.config.goal

    @cached_property
    def volume(self) -> float:
        """Of the body [m^3]. Raises ValueError for a scene without a body."""
        body = self.config.scene.body
        if body is None:
            raise ValueError("task 'relief' needs a scene with a body")
        return shapes.enclosed_volume(body.geometry)

    def require_reachable(self, start: Truth) -> None:
        body = self.config.scene.body
        assert body is not None  # a rig without one has no truth
        length, _, height = shapes.bounding_size(body.geometry).tolist()
        reach = max(abs(place) for place in self.config.places)
        if not reach < length / 2:
            raise GoalOutOfReach(
                f"task.places: a dent at {1e3 * reach:g} mm is off the body, which is {1e3 * length:g} mm long along x"
            )
        if not max(self.config.goal) < height / 2:
            raise GoalOutOfReach(
                f"task.goal: a dent of {1e3 * max(self.config.goal):g} mm; give less than half of the body's height, "
                f"{1e3 * height:g} mm"
            )

    def depths(self, truth: Truth, start: Truth) -> FloatArray:
        """(dents,) how far the top of the body has sunk at each place since `start` [m]: the mean over the outermost
        layer of particles that lay within DENT_WIDTH / 2 of the place along x, and as far from the middle along y."""
        dent_width = 4e-3
        points, first = (each.points.astype(np.float64) for each in (truth, start))
        middle, spacing = first.mean(axis=0), (self.volume / len(first)) ** (1 / 3)
        is_top = first[:, 2] > first[:, 2].max() - spacing / 2
        near = np.abs(first[:, 1] - middle[1]) <= dent_width / 2
        found = []
        for place in self.config.places:
            here = is_top & near & (np.abs(first[:, 0] - middle[0] - place) <= dent_width / 2)
            found.append(float((first[here, 2] - points[here, 2]).mean()))
        return np.array(found)

    def distance(self, truth: Truth, start: Truth) -> float:
        return float(np.sqrt(np.mean((self.depths(truth, start) - self.config.goal) ** 2)))

    def measures(self, truth: Truth, start: Truth) -> Mapping[str, float]:
        """Depth of each dent [m]: `depth_1`, `depth_2`."""
        return {f"depth_{number}": float(depth) for number, depth in enumerate(self.depths(truth, start), 1)}

    def scripted(self, *, through: bool = False) -> Policy:
        goal = (math.inf,) * len(self.config.goal) if through else self.config.goal
        return ScriptedRelief(self.config, goal, MAX_PRESSES, FIRST_EXCESS)

    def analytic(self) -> Policy:
        return ScriptedRelief(self.config, self.config.goal, 1, ONLY_EXCESS)


class ScriptedRelief:
    """Presses each dent, lifts until the gel hardly touches, and measures by that what has remained of the dent; then
    presses deeper by what is missing.

    goal: depths [m]; infinite: it presses the first dent on and on. max_presses: of a dent at one visit; 1: each dent
    is pressed once. first_excess: by which the first press of a dent goes deeper than its goal [m].
    """

    def __init__(self, config: ReliefConfig, goal: Sequence[float], max_presses: int, first_excess: float) -> None:
        self._config, self._goal, self._max_presses, self._first_excess = config, goal, max_presses, first_excess
        self._motion: Motion | None = None
        body = config.scene.body
        assert body is not None  # the task refuses a scene without one
        self._max_depth = float(shapes.bounding_size(body.geometry)[2]) / 2  # no goal is deeper [m]

    @property
    def needs(self) -> Needs:
        return Needs(arms=frozenset({"upper"}))

    def reset(self) -> None:
        self._motion = None

    def __call__(self, observation: Observation) -> Action:
        if self._motion is None:
            self._motion = self._press_all(observation)
            return next(self._motion)
        return self._motion.send(observation)

    def _press_all(self, observation: Observation) -> Motion:
        """All dents, again and again until each has its depth, since a dent lifts or sinks those next to it."""
        surface = _height(observation)  # a reset ends with a light touch
        lowest = surface - self._max_depth
        heights, pressed = dict[int, float](), dict[int, float]()
        is_done = False
        while not is_done:
            is_done = True
            for number, (place, goal) in enumerate(zip(self._config.places, self._goal, strict=True)):
                observation = yield from self._go(observation, _place(observation), surface + RELIEF_CLEARANCE)
                observation = yield from self._go(observation, place, surface + RELIEF_CLEARANCE)
                observation = yield from self._touch(
                    observation, heights.get(number, surface) - pressed.get(number, 0.0), lowest
                )
                if _normal_force(observation) < MIN_RELIEF_FORCE:  # there is no clay
                    continue
                top = heights.setdefault(number, _height(observation))
                if goal - (top - _height(observation)) > RELIEF_TOLERANCE:
                    is_done = self._max_presses == 1
                    observation = yield from self._press_dent(observation, top, goal)
                pressed[number] = top - _height(observation)
        observation = yield from self._go(observation, _place(observation), surface + RELIEF_CLEARANCE)
        while True:
            observation = yield self._step(observation, 0.0, 0.0)

    def _press_dent(self, observation: Observation, top: float, goal: float) -> Motion:
        """From a light touch to a light touch. top: height of the sensor that touched the untouched body [m]. A part of
        each press springs back, so pressing deeper by what is missing does not go too deep."""
        reach = goal + self._first_excess
        for _ in range(self._max_presses):
            observation = yield from self._go(observation, _place(observation), top - reach)
            observation = yield from self._release(observation)
            left = goal - (top - _height(observation))
            if left <= RELIEF_TOLERANCE:
                break
            reach += left
        return observation

    def _go(self, observation: Observation, x: float, height: float) -> Motion:
        """Straight to a place [m] and height [m] of the upper sensor."""
        arrival = 1e-6
        while max(abs(x - _place(observation)), abs(height - _height(observation))) > arrival:
            observation = yield self._step(observation, x - _place(observation), height - _height(observation))
        return observation

    def _touch(self, observation: Observation, surface: float, lowest: float) -> Motion:
        """Down until the gel touches, slowly from near the height [m] at which it is expected to; no further down than
        the height `lowest` [m], where there is no clay."""
        observation = yield from self._go(observation, _place(observation), surface + 2.0 * TOUCH_STEP)
        while _normal_force(observation) < MIN_RELIEF_FORCE and _height(observation) > lowest:
            observation = yield self._step(observation, 0.0, -TOUCH_STEP)
        return observation

    def _release(self, observation: Observation) -> Motion:
        """Up until the gel hardly touches, and the slower the less force is left."""
        most, longest = _normal_force(observation), self._config.max_step
        while (force := _normal_force(observation)) > MIN_RELIEF_FORCE:
            observation = yield self._step(observation, 0.0, max(TOUCH_STEP, longest * force / most))
        return observation

    def _step(self, observation: Observation, x: float, z: float) -> Action:
        """The upper sensor moves by x and z, each at most max_step [m]."""
        longest, pose = self._config.max_step, observation.arms["upper"].pose
        shift = np.clip([x, 0.0, z], -longest, longest)
        return Action({"upper": Pose(pose.position + shift, pose.quaternion)})


def _place(observation: Observation) -> float:
    """x of the upper sensor [m]."""
    return float(observation.arms["upper"].pose.position[0])


def _height(observation: Observation) -> float:
    """z of the upper sensor [m]."""
    return float(observation.arms["upper"].pose.position[2])


def _normal_force(observation: Observation) -> float:
    """On the upper sensor [N]."""
    return -float(observation.arms["upper"].wrench[2])

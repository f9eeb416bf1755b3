"""The baselines without a file as policies of any rig that knows the truth: random, blind, analytic, teacher."""

from __future__ import annotations

from collections.abc import Callable

from robot.deploy.axis_motion import AxisMotion
from robot.train.benchmark.blind import BlindMotion, load_blind, start_numbers
from robot.train.benchmark.policies import ANALYTIC, BLIND, RANDOM, TEACHER, random_vectors
from tacsim.interface import Action, Float32, Needs, Observation, Policy, Truth
from tacsim.rig import Rig
from tacsim.tasks import Task
from tacsim.tasks.task import needs_of_axes

Vectors = Callable[[Observation], Float32]  # the action vector of each observation of an episode


class VectorPolicy:
    """A policy that gives action vectors. `begin` is called with the first observation of each episode."""

    def __init__(self, task: Task, begin: Callable[[Observation], Vectors]) -> None:
        self._begin = begin
        self._motion = AxisMotion(task.axes, task.config.max_step)
        self._needs = needs_of_axes(task.axes)
        self._vectors: Vectors | None = None

    @property
    def needs(self) -> Needs:
        return self._needs

    def reset(self) -> None:
        self._motion.begin()
        self._vectors = None

    def __call__(self, observation: Observation) -> Action:
        if self._vectors is None:
            self._vectors = self._begin(observation)
        return self._motion.action(self._vectors(observation), observation)


def require_baseline(name: str, task_name: str, task: Task) -> None:
    """Raises BlindMissing; ValueError for a task without a rule (`analytic`)."""
    if name == ANALYTIC:
        task.analytic()
    elif name == BLIND:
        load_blind(task_name, task)


def load_baseline(name: str, task_name: str, number: int, rig: Rig, task: Task) -> Policy:
    """A baseline in episode `number` of a task file. Raises as `require_baseline`."""
    if name == ANALYTIC:
        return task.analytic()
    if name == TEACHER:
        return Teacher(rig, task)
    if name == BLIND:
        weights = load_blind(task_name, task)
        return VectorPolicy(task, lambda first: BlindMotion(weights, start_numbers(task.goal, first)))
    assert name == RANDOM
    vectors = random_vectors(task_name, number, task)

    def begin(first: Observation) -> Vectors:
        remaining = iter(vectors)
        return lambda observation: next(remaining)

    return VectorPolicy(task, begin)


class Teacher:
    """By the truth of the rig at each observation; where the task has no such rule, its `teacher`."""

    def __init__(self, rig: Rig, task: Task) -> None:
        self._rig, self._task, self._by_touch = rig, task, task.teacher()
        self._motion = AxisMotion(task.axes, task.config.max_step)
        self._start: Truth | None = None

    @property
    def needs(self) -> Needs:
        return self._by_touch.needs

    def reset(self) -> None:
        self._motion.begin()
        self._by_touch.reset()
        self._start = None

    def __call__(self, observation: Observation) -> Action:
        truth = self._rig.truth()
        if truth is None:
            raise RuntimeError(f"rig '{self._rig.name}' knows no truth, which 'teacher' needs")
        self._start = self._start or truth
        vector = self._task.expert(truth, self._start)
        return self._by_touch(observation) if vector is None else self._motion.action(vector, observation)

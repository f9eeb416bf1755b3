"""Policies of the benchmark by name, as functions of the environment, and the hashes of their files."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robot.deploy.policy import (
    describe_outside,
    has_training_range,
    load_policy,
    require_fit,
    require_policy_name,
    reset_policy,
)
from robot.train.benchmark.blind import BlindMotion, blind_path, load_blind, start_numbers
from robot.train.benchmark.hashing import hash_document, hash_file, uniform_numbers
from tacsim.config import config_root
from tacsim.gym.env import TacsimEnv
from tacsim.interface import Float32, Policy
from tacsim.models.sensor import CanonicalGrid
from tacsim.tasks import Task

RANDOM, BLIND, ANALYTIC, SCRIPTED, TEACHER = "random", "blind", "analytic", "scripted", "teacher"
BASELINES = (RANDOM, BLIND, ANALYTIC, SCRIPTED, TEACHER)
Act = Callable[[TacsimEnv], NDArray[np.float32]]


class PolicyError(RuntimeError):
    """A policy raised, or gave an action that is none."""


class Actor:
    """A policy in one episode of one environment."""

    def __init__(self, name: str, task: str, number: int, env: TacsimEnv, canonical: CanonicalGrid) -> None:
        """Raises PolicyNotFound, IncompatibleRig; PolicyError if the policy cannot be reset."""
        self._name = name
        self._policy: Policy | None = None
        if name == TEACHER:
            self._act: Act = lambda env: env.expert()
        elif name == RANDOM:
            self._actions = iter(random_vectors(task, number, env.task))
            self._act = lambda env: next(self._actions)
        elif name == BLIND:
            motion = BlindMotion(load_blind(task, env.task), start_numbers(env.task.goal, env.observation))
            self._act = lambda env: motion(env.observation)
        else:
            self._policy = policy = (
                env.task.analytic() if name == ANALYTIC else load_fitting_policy(name, env, canonical)
            )
            self._act = lambda env: env.policy_action(policy)
            try:
                reset_policy(policy, env.task)
            except (Exception, SystemExit) as failure:
                raise PolicyError(f"{type(failure).__name__} in reset: {failure}") from failure

    def __call__(self, env: TacsimEnv) -> NDArray[np.float32]:
        """The action vector (n,) within [-1, 1]. Raises PolicyError."""
        try:
            action = np.asarray(self._act(env), np.float32)
        except (Exception, SystemExit) as failure:  # a policy may end Python
            raise PolicyError(f"{type(failure).__name__}: {failure}") from failure
        if action.shape != (len(env.task.axes),) or not np.isfinite(action).all():
            raise PolicyError(
                f"its action {action.tolist()} is not {len(env.task.axes)} finite numbers, one for each free axis"
            )
        return action.clip(-1.0, 1.0)

    @property
    def outside(self) -> bool | None:
        """A learned policy has left the range of its training in this episode; None: unknown."""
        return bool(describe_outside(self._policy)) if has_training_range(self._policy) else None

    @property
    def policy(self) -> Policy | None:
        """As loaded; None for those that act by the environment."""
        return self._policy


def random_vectors(task_name: str, number: int, task: Task) -> Float32:
    """(steps, axes) the actions of `random` in episode `number` of a task file."""
    count = len(task.axes)
    drawn = uniform_numbers(f"{Path(task_name).stem}:{number}", count * task.config.steps)
    return np.array(drawn, np.float32).reshape(-1, count)


def load_fitting_policy(name: str, env: TacsimEnv, canonical: CanonicalGrid) -> Policy:
    """A policy of `load_policy` that fits the rig and the task. Raises PolicyNotFound, IncompatibleRig."""
    policy = load_policy(name, env.task, env.rig.spec, canonical, BASELINES)
    require_fit(env.rig.name, env.rig.spec, policy, name, env.task)
    return policy


def hash_policy(name: str, task_name: str, task_kind: str) -> str:
    """SHA-256 of the file of a policy, or of the name of a built-in one, whose code belongs to the simulator's.

    Raises PolicyNotFound for a policy that does not exist.
    """
    require_policy_name(name, BASELINES)
    if name == BLIND:
        return hash_file(blind_path(task_name))
    if name == "learned":
        path = config_root() / "policies" / f"{task_kind}.onnx"
        return hash_file(path) if path.is_file() else hash_document(name)
    if name.endswith((".onnx", ".csv")):
        return hash_file(Path(name))
    if ":" in name:
        return _hash_module(name.partition(":")[0], name)
    return hash_document(name)


def _hash_module(module: str, name: str) -> str:
    """Of the source file of a module and the name in it; other files that it imports are not included."""
    try:
        found = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        found = None
    origin = None if found is None else found.origin
    if origin is None or not Path(origin).is_file():
        return hash_document(name)
    return hash_document([hash_file(Path(origin)), name.partition(":")[2]])

"""The baseline `blind`: an open-loop motion that does not depend on touch.

It knows what a robot without tactile sensors knows: the goal, and where its arms are when the episode begins. Each
number of its action is a linear function of these, fitted by ridge regression to the teacher in episodes that are drawn
like those of the test split, by another seed. The weights are frozen in NAME.blind.json next to the task file.
"""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from robot.common.whole_file import write_whole
from robot.train.benchmark.episodes import task_path
from tacsim.interface import Float32, FloatArray, Observation
from tacsim.models.quantity import Config
from tacsim.tasks import Task

RIDGE = 1e-3  # relative to the number of episodes, of features with deviation 1
MIN_DEVIATION = 1e-9  # of a feature [m]; one that varies less is left out


class BlindWeights(Config):
    """Content of NAME.blind.json. Action of step t, axis a: sum over f of `weights[t][a][f]` times feature f; the
    features are 1 and the numbers of `start_numbers` minus `mean`, divided by `deviation`."""

    task: str
    episodes: int  # that it was fitted to
    axes: int
    mean: tuple[float, ...]  # of each number [m]
    deviation: tuple[float, ...]  # [m]; 0: left out
    weights: tuple[tuple[tuple[float, ...], ...], ...]  # (steps, axes, 1 + numbers)


class BlindMissing(ValueError):
    """There are no weights for the blind motion of a task."""


def blind_file(task_name: str) -> Path:
    """Where the weights of a task are, or will be."""
    path = task_path(task_name)
    return path.with_name(f"{path.stem}.blind.json")


def blind_path(task_name: str) -> Path:
    """Path of the weights of a task. Raises BlindMissing."""
    found = blind_file(task_name)
    if not found.is_file():
        raise BlindMissing(f"{found}: no such file; fit the blind motion first: tacsim benchmark fit-blind {task_name}")
    return found


def start_numbers(goal: float | tuple[float, ...], observation: Observation) -> FloatArray:
    """(n,) what is known without touch when an episode begins [m]: the goal, and the poses of the arms as the robot
    assumes them, relative to the first arm."""
    arms = list(observation.arms.values())
    between = [arm.pose.position - arms[0].pose.position for arm in arms[1:]]
    numbers: FloatArray = np.concatenate([np.atleast_1d(goal), *between])
    return numbers


class BlindMotion:
    """The motion in one episode. `start`: (n,) its `start_numbers`."""

    def __init__(self, weights: BlindWeights, start: FloatArray) -> None:
        mean, deviation = np.array(weights.mean), np.array(weights.deviation)
        scaled = np.where(deviation > 0, (start - mean) / np.where(deviation > 0, deviation, 1.0), 0.0)
        self._actions: FloatArray = np.array(weights.weights) @ np.append(1.0, scaled)
        self._step = 0

    def __call__(self, observation: Observation) -> Float32:
        action = self._actions[min(self._step, len(self._actions) - 1)]
        self._step += 1
        return np.asarray(action.clip(-1.0, 1.0), np.float32)


@lru_cache(maxsize=8)
def _read_weights(path: Path) -> BlindWeights:
    try:
        return BlindWeights.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise BlindMissing(f"{path}: no weights of a blind motion: {error.errors()[0]['msg']}") from None


def load_blind(task_name: str, task: Task) -> BlindWeights:
    """The weights of a task. Raises BlindMissing if there are none, or if they belong to other axes."""
    weights = _read_weights(blind_path(task_name))
    if weights.axes != len(task.axes):
        raise BlindMissing(
            f"the blind motion of '{task_name}' has {weights.axes} axes, the task has {len(task.axes)}: fit it again"
        )
    return weights


def fit_blind(task_name: str, starts: FloatArray, actions: FloatArray) -> BlindWeights:
    """Fits the weights to starts (episodes, numbers) and the actions (episodes, steps, axes) of the teacher."""
    mean, deviation = starts.mean(axis=0), starts.std(axis=0)
    deviation = np.where(deviation < MIN_DEVIATION, 0.0, deviation)
    scaled = np.where(deviation > 0, (starts - mean) / np.where(deviation > 0, deviation, 1.0), 0.0)
    features = np.column_stack([np.ones(len(starts)), scaled])
    penalty = RIDGE * len(starts) * np.eye(features.shape[1])
    penalty[0, 0] = 0.0  # not of the mean
    flat = actions.reshape(len(actions), -1)
    solved = np.linalg.solve(features.T @ features + penalty, features.T @ flat)
    weights = solved.T.reshape(*actions.shape[1:], -1)
    return BlindWeights(
        task=task_name,
        episodes=len(starts),
        axes=actions.shape[2],
        mean=tuple(float(f"{each:.6g}") for each in mean),
        deviation=tuple(float(f"{each:.6g}") for each in deviation),
        weights=tuple(
            tuple(tuple(float(f"{each:.4g}") for each in axis) for axis in step) for step in weights.tolist()
        ),
    )


def write_blind(task_name: str, weights: BlindWeights) -> Path:
    """Writes the weights next to the task file. Raises FileExistsError."""
    path = blind_file(task_name)
    if path.exists():
        raise FileExistsError(17, "File exists", str(path))
    whole = weights.model_dump(mode="json")
    rows = ",\n".join(json.dumps(step, separators=(",", ":")) for step in whole.pop("weights"))
    write_whole(path, f'{json.dumps(whole)[:-1]}, "weights": [\n{rows}\n]}}\n'.encode())
    return path

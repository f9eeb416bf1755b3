"""A person's own policy: Python code, or a table of targets (CSV)."""

from __future__ import annotations

import csv
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from robot.common.code import CodeNotFound, load_attribute
from tacsim import pose as se3
from tacsim.interface import Action, FloatArray, Needs, Observation, Policy, Pose
from tacsim.record.sources import read_columns

AXES = ("x", "y", "z", "rx", "ry", "rz")  # [m], and a rotation vector [rad]


class PolicyNotFound(ValueError):
    """No policy has this name."""


class FunctionPolicy:
    """A function from Observation to Action as a policy without needs and without state."""

    needs = Needs()

    def __init__(self, act: Callable[[Observation], Action]) -> None:
        self._act = act

    def reset(self) -> None:
        """A function has no state."""

    def __call__(self, observation: Observation) -> Action:
        return self._act(observation)


def policy_of_code(name: str) -> Policy:
    """The policy at "package.module:attribute": an object with needs, reset and __call__ like tacsim.Policy, a class of
    such objects (created without arguments), or a function from Observation to Action.

    Runs code of that module. Raises PolicyNotFound.
    """
    try:
        found = load_attribute(name)
    except CodeNotFound as failure:
        raise PolicyNotFound(f"policy {failure}") from failure
    return _as_policy(found, name)


def _as_policy(found: object, name: str) -> Policy:
    if inspect.isclass(found):
        try:
            found = found()
        except Exception as failure:
            raise PolicyNotFound(
                f"policy '{name}': the class cannot be created without arguments: {failure!r}"
            ) from failure
    if isinstance(found, Policy):
        if not isinstance(found.needs, Needs):
            raise PolicyNotFound(f"policy '{name}': its needs must be a tacsim.Needs, got {type(found.needs).__name__}")
        return found
    if callable(found):
        return FunctionPolicy(found)
    raise PolicyNotFound(
        f"policy '{name}' is a {type(found).__name__}: not a policy and not a function of an Observation"
    )


class TargetScript:
    """Moves arms through the rows of a table, then holds.

    A column ARM.AXIS is the displacement of that arm's sensor from its pose at the first observation, along its axes in
    that pose (z out of the gel, towards the object). Missing columns are 0.

    Raises PolicyNotFound if the file is not such a table.
    """

    def __init__(self, path: Path) -> None:
        max_rows = 100_000
        try:
            with path.open(newline="", encoding="utf-8-sig") as file:
                header = [name.strip() for name in next(csv.reader(file), [])]
        except (OSError, UnicodeDecodeError, csv.Error) as failure:
            raise PolicyNotFound(f"policy '{path}': not a readable CSV file: {failure}") from failure
        split = [tuple(name.rpartition(".")[::2]) for name in header]
        wrong = [name for name, (arm, axis) in zip(header, split, strict=True) if not arm or axis not in AXES]
        if wrong or not header:
            found = f"found '{wrong[0]}'" if wrong else "found none"
            raise PolicyNotFound(
                f"policy '{path}': columns are ARM.AXIS, such as upper.z, with an axis of {', '.join(AXES)}; {found}"
            )
        try:
            rows = np.array(read_columns(path, header))
        except ValueError as failure:
            raise PolicyNotFound(f"policy '{failure}'") from failure
        if len(rows) > max_rows:
            raise PolicyNotFound(f"policy '{path}': {len(rows)} rows, the maximum is {max_rows}")
        self._offsets: dict[str, FloatArray] = {}
        for column, (arm, axis) in enumerate(split):
            self._offsets.setdefault(arm, np.zeros((len(rows), 6)))[:, AXES.index(axis)] = rows[:, column]
        self.rows = len(rows)
        self.reset()

    @property
    def needs(self) -> Needs:
        return Needs(arms=frozenset(self._offsets))

    def reset(self) -> None:
        self._start: Mapping[str, Pose] = {}
        self._row = 0

    def __call__(self, observation: Observation) -> Action:
        if not self._start:
            self._start = {arm: observation.arms[arm].pose for arm in self._offsets}
        row, self._row = min(self._row, self.rows - 1), self._row + 1
        targets = {}
        for arm, offsets in self._offsets.items():
            targets[arm] = se3.compose(self._start[arm], se3.from_rotation_vector(offsets[row, :3], offsets[row, 3:]))
        return Action(targets)

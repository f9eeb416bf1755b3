"""A motion written down: a CSV table of targets, one row a control step."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from robot.deploy.python_policy import PolicyNotFound
from tacsim import pose as se3
from tacsim.interface import Action, FloatArray, Needs, Observation, Pose
from tacsim.record.sources import read_columns

AXES = ("x", "y", "z", "rx", "ry", "rz")  # [m], and a rotation vector [rad]
MOST_ROWS = 100_000


class TargetScript:
    """Moves arms through the rows of a table, then holds.

    A column is ARM.AXIS: how far the sensor of that arm shall be from where it was at the first observation, along its
    own axes there (z out of the gel, towards what it touches). Columns that are not there are 0.

    Raises PolicyNotFound for a file that is no such table.
    """

    def __init__(self, path: Path) -> None:
        try:
            with path.open(newline="", encoding="utf-8-sig") as file:
                header = [name.strip() for name in next(csv.reader(file), [])]
        except (OSError, UnicodeDecodeError, csv.Error) as failure:
            raise PolicyNotFound(f"policy '{path}': no readable CSV file: {failure}") from failure
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
        if len(rows) > MOST_ROWS:
            raise PolicyNotFound(f"policy '{path}': {len(rows)} rows, at most {MOST_ROWS}")
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

"""The CSV record of a parallel gripper, one row for each frame, as states of the arm that carries a tactile finger."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np

from tacsim.interface import ArmState, Pose
from tacsim.record.episode import EpisodeError

MAX_CSV = 64 << 20  # [bytes]


def read_columns(path: Path, names: list[str]) -> list[tuple[float, ...]]:
    """The named columns of a CSV file with a header, one tuple for each row.

    Raises EpisodeError for a file that is missing or too large, a missing column, a value that is not a finite number,
    and a column `frame` that does not count the rows from 0.
    """
    try:
        if path.stat().st_size > MAX_CSV:
            raise EpisodeError(f"{path}: {path.stat().st_size} bytes; at most {MAX_CSV} are read")
        with path.open(newline="", encoding="utf-8-sig") as file:
            return _rows(csv.DictReader(file, skipinitialspace=True), path, names)
    except (OSError, UnicodeDecodeError, csv.Error) as failure:
        raise EpisodeError(f"{path}: no readable CSV file: {failure}") from failure


def _rows(reader: csv.DictReader[str], path: Path, names: list[str]) -> list[tuple[float, ...]]:
    header = [column.strip() for column in reader.fieldnames or []]
    reader.fieldnames = header
    for name in names:
        if name not in header:
            raise EpisodeError(f"{path}: no column '{name}'; it has: {', '.join(header) or '(nothing)'}")
    rows = []
    for number, row in enumerate(reader):
        rows.append(tuple(_number(row[name], path, reader.line_num, name) for name in names))
        if "frame" in header and _number(row["frame"], path, reader.line_num, "frame") != number:
            raise EpisodeError(
                f"{path}:{reader.line_num}: frame {row['frame']} in row {number}; give each frame a row, from 0"
            )
    if not rows:
        raise EpisodeError(f"{path}: a header without rows")
    return rows


def _number(text: str | None, path: Path, line: int, column: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise EpisodeError(f"{path}:{line}: column '{column}': '{text or ''}' is not a finite number")
    return value


def finger_states(rows: list[tuple[float, ...]], period: float, lower: bool) -> list[ArmState]:
    """Arm states of one finger of a parallel gripper from (force [N],) or (force [N], opening [m]) a row.

    World is the gripper: origin midway between the fingers, z along the closing direction. The fingers close evenly:
    the upper one sits at z = +opening / 2 and faces down, the lower one at -opening / 2 and faces up. Without an
    opening the pose stays at the origin. A pressing force pushes the sensor back into its mount: wrench Fz = -force;
    the other five components were not measured and are 0. Twist: difference to the row before over `period` [s].
    """
    side = -1.0 if lower else 1.0
    quaternion = np.array([0.0, 0.0, 0.0, 1.0] if lower else [1.0, 0.0, 0.0, 0.0])  # half a turn about x
    states: list[ArmState] = []
    before = None
    for number, (force, *opening) in enumerate(rows):
        z = side * opening[0] / 2.0 if opening else 0.0
        speed = 0.0 if before is None else (z - before) / period
        before = z
        states.append(
            ArmState(
                pose=Pose(np.array([0.0, 0.0, z]), quaternion),
                twist=np.array([0.0, 0.0, speed, 0.0, 0.0, 0.0]),
                wrench=np.array([0.0, 0.0, -force, 0.0, 0.0, 0.0]),
                joints=None,
                time=number * period,
            )
        )
    return states

"""Files of recorded poses, from which the frames of a robot are calibrated, and results as JSON.

YAML (or JSON, which is YAML): lengths and angles with units, or in m and rad. A pose is a position and a rotation
vector, as UR writes it. A recorded file has one entry a line, in braces, and says how many there are, so a file
that was cut off is recognised wherever the cut is.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import yaml
from pydantic import AfterValidator, Field, ValidationInfo
from pydantic_core import PydanticCustomError

from calibration.poses.ball_touch import BallTouch
from calibration.poses.hand_eye import BoardPose
from tacsim.config import load_model
from tacsim.interface import FloatArray, Pose
from tacsim.models.hardware import Placement
from tacsim.models.quantity import Config, Length
from tacsim.pose import rotation

Entry = TypeVar("Entry")

MAX_ENTRIES = 1000  # of a file

Count = Annotated[
    int | None, Field(ge=0, le=MAX_ENTRIES)
]  # entries of a complete file; None: not given, written by hand


def _require_complete(entries: tuple[Entry, ...], info: ValidationInfo) -> tuple[Entry, ...]:
    """Refuses a file that was cut off."""
    count = info.data.get("count")
    if count is not None and count != len(entries):
        raise PydanticCustomError(
            "cut_off",
            "holds {held} entries, `count` says {expected}: the file was cut off, or changed by hand; record again, or "
            "correct `count` if the rest is right",
            {"held": len(entries), "expected": count, "at": ()},
        )
    return entries


class TouchEntry(Config):
    """One touch of the ball."""

    tool: Placement  # world_from_tool
    contact: tuple[Length, Length]  # its centre in the sensor's frame, x, y [m]
    depth: Annotated[Length, Field(ge=0)]  # of the ball in the gel [m]


class TouchFile(Config):
    """Touches of one fixed ball."""

    ball_radius: Annotated[Length, Field(gt=0)]
    count: Count = None
    touches: Annotated[tuple[TouchEntry, ...], Field(max_length=MAX_ENTRIES), AfterValidator(_require_complete)]

    def measurements(self) -> list[BallTouch]:
        return [BallTouch(each.tool.pose, each.contact, each.depth) for each in self.touches]


class BoardPoseEntry(Config):
    """One picture of the board."""

    flange: Placement  # base_from_flange
    board: Placement  # camera_from_board


class BoardPoseFile(Config):
    """Poses of one board, seen by one camera."""

    # "flange": the camera is on the flange and the board is fixed; "fixed": the board is on the flange
    camera: Literal["flange", "fixed"] = "flange"
    count: Count = None
    poses: Annotated[tuple[BoardPoseEntry, ...], Field(max_length=MAX_ENTRIES), AfterValidator(_require_complete)]

    def measurements(self) -> list[BoardPose]:
        return [BoardPose(each.flange.pose, each.board.pose) for each in self.poses]


def read_touches(path: Path) -> TouchFile:
    """Raises tacsim.config.ConfigError."""
    return load_model(TouchFile, path)


def read_board_poses(path: Path) -> BoardPoseFile:
    """Raises tacsim.config.ConfigError."""
    return load_model(BoardPoseFile, path)


def touch_file(touches: Sequence[BallTouch], ball_radius: float) -> TouchFile:
    """The content of a file of touches, for `write_record`."""
    entries = tuple(
        TouchEntry(tool=placement_of_pose(t.tool), contact=t.contact, depth=max(0.0, t.depth)) for t in touches
    )
    return TouchFile(ball_radius=ball_radius, count=len(entries), touches=entries)


def board_pose_file(board_poses: Sequence[BoardPose], *, fixed: bool) -> BoardPoseFile:
    """The content of a file of board poses, for `write_record`."""
    entries = tuple(
        BoardPoseEntry(flange=placement_of_pose(s.flange), board=placement_of_pose(s.board)) for s in board_poses
    )
    return BoardPoseFile(camera="fixed" if fixed else "flange", count=len(entries), poses=entries)


def write_record(path: Path, record: TouchFile | BoardPoseFile) -> Path:
    """Writes a file for the functions above, and replaces an existing one. Raises OSError."""
    lines = []
    for key, value in record.model_dump(mode="json").items():
        if isinstance(value, list):
            entries = [yaml.safe_dump(entry, sort_keys=False, default_flow_style=True, width=1000) for entry in value]
            lines += [f"{key}:\n", *(f"- {entry}" for entry in entries)] if entries else [f"{key}: []\n"]
        else:
            lines.append(yaml.safe_dump({key: value}))
    new = path.with_name(path.name + ".new")  # the old file stays complete until the new one is
    with new.open("w", encoding="utf-8") as file:
        file.write("".join(lines))
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)
    return path


def placement_of_pose(pose: Pose) -> Placement:
    """A pose as files write it: position [m] and rotation vector [rad]."""
    x, y, z = (float(value) for value in pose.position)
    a, b, c = (float(value) for value in rotation(pose).as_rotvec())
    return Placement(position=(x, y, z), rotation=(a, b, c))


def pose_as_json(pose: Pose, covariance: FloatArray | None = None) -> dict[str, Any]:
    """A pose for JSON [m, rad]; `covariance` (6, 6): of shift and rotation vector."""
    found: dict[str, Any] = placement_of_pose(pose).model_dump(mode="json")
    if covariance is not None:
        found["covariance"] = covariance.tolist()
    return found

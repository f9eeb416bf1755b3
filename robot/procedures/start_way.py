"""The way of an arm from where it stands to its start: found and checked before anything moves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from robot.arm.rtde import Reading
from robot.arm.start_servo import sensor_path, way_rates
from robot.common.kinematics import Kinematics, inverse_frame, matrix
from robot.common.tcp import ArmFrames
from robot.errors import DeviceError
from tacsim import pose as se3
from tacsim.interface import FloatArray, Pose
from tacsim.limits import Region
from tacsim.models.hardware import UrArmConfig

SAMPLE = 5e-3  # between two points of a way at which it is checked [rad of the joint that turns most]
SAG = 10e-3  # below both ends and the workspace, where the file has no walls, and so no table [m]
NEAR_LINE = 0.5e-3  # nearer to a wall by no more than that is not nearer [m]
KEEP_OUT_MARGIN = 10e-3  # beyond the keep-out distance, between a way and the other sensors [m]
AT_START = 1e-3  # an arm whose joints are all this near to the start's stands there [rad]
JOINTS = ("base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3")  # as on the pendant


class NoWay(DeviceError):
    """The arm cannot be led to its start; the words say why, and what to do."""


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """Straight in joint space."""

    begin: FloatArray  # (6,) joints [rad]
    end: FloatArray  # (6,)
    path: FloatArray  # (n, 3) of the sensor's origin on the way, world axes [m]
    seconds: float

    @property
    def is_there(self) -> bool:
        """True if the arm stands at its start."""
        return float(np.abs(self.end - self.begin).max()) < AT_START

    def describe(self) -> str:
        """What a person should know who watches it."""
        turns = np.degrees(self.end - self.begin)
        joint = int(np.abs(turns).argmax())
        lowest, highest = self.path[:, 2].min(), self.path[:, 2].max()
        length = float(np.linalg.norm(np.diff(self.path, axis=0), axis=1).sum())
        return (
            f"the joint that turns most is {JOINTS[joint]}, by {turns[joint]:+.0f} deg; the sensor goes "
            f"{1e3 * length:.0f} mm, from {_mm(self.path[0])} to {_mm(self.path[-1])} mm in the world, at heights from "
            f"{1e3 * lowest:.0f} to {1e3 * highest:.0f} mm; about {self.seconds:.0f} s"
        )


def find_way(name: str, config: UrArmConfig, reading: Reading, start: Pose) -> Way:
    """The straight way in joint space to the nearest posture that has the sensor at `start`.

    Raises NoWay: out of reach, or the sensor would go farther behind a wall (limits.planes) than it is at both ends; in
    a file without walls, lower than both ends and the workspace.
    """
    kinematics, frames, begin = Kinematics(config.model), ArmFrames.of(config), reading.joints
    goal = frames.flange(se3.to_matrix(start))
    if reading.tcp is not None:  # a real arm's own lengths, as far as they show here
        flange = matrix(reading.tcp_pose) @ inverse_frame(matrix(reading.tcp))
        goal = goal @ inverse_frame(flange) @ kinematics.forward(begin)
    postures = kinematics.solutions(goal, begin)
    if not postures:
        raise NoWay(f"arm '{name}': its start is out of reach; correct start, world_from_base, or the mount")
    end = min(postures, key=lambda q: float(np.abs(q - begin).max()))
    steps = max(2, int(np.abs(end - begin).max() / SAMPLE))
    joints = begin + np.linspace(0.0, 1.0, steps + 1)[:, None] * (end - begin)
    path = sensor_path(kinematics, frames, joints)[:, :3, 3]
    region = config.limits.region
    if len(region.normals) > 6:
        walls = Region(region.normals[6:], region.offsets[6:], region.names[6:])  # behind the six faces of the box
        beyond = walls.excess(path)
        worst = int(beyond.argmax())
        if beyond[worst] > max(0.0, beyond[0], beyond[-1]) + NEAR_LINE:
            raise NoWay(
                f"arm '{name}': on the straight way of the joints its sensor would come "
                f"{walls.violated_face(path[worst])}; jog it nearer to its start by hand first"
            )
    else:
        sunk = min(path[0, 2], path[-1, 2], config.limits.workspace.lower[2]) - float(path[:, 2].min())
        if sunk > SAG:
            raise NoWay(
                f"arm '{name}': on the straight way of the joints its sensor would sink {1e3 * sunk:.0f} mm below "
                "where it stands, its start and its workspace; give the table as a plane (limits.planes), or jog it "
                "nearer to its start by hand first"
            )
    top, acceleration = way_rates(kinematics, frames, begin, end, config.limits)
    return Way(begin, end, path, float(np.linalg.norm(end - begin)) / top + top / acceleration)


def require_clear(name: str, way: Way, others: Mapping[str, FloatArray], distances: Mapping[str, float]) -> None:
    """Raises NoWay where the sensor would come too near to those of other arms, at (3,) [m] in the world."""
    for other, place in others.items():
        gaps, least = np.linalg.norm(way.path - place, axis=1), distances.get(other, 0.0) + KEEP_OUT_MARGIN
        if gaps.min() < min(least, gaps[0] - NEAR_LINE, gaps[-1] - NEAR_LINE):
            raise NoWay(
                f"arm '{name}': on its way its sensor would come within {1e3 * gaps.min():.0f} mm of that of arm "
                f"'{other}'; jog one of them away by hand first"
            )


def _mm(point: FloatArray) -> str:
    return "[" + ", ".join(str(round(1e3 * value)) for value in point) + "]"

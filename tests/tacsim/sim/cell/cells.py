"""Cells for tests: a free hand, a UR5e, around a small box."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from robot.common.kinematics import MODELS
from tacsim.interface import Pose
from tacsim.models.scene import Scene
from tacsim.sim.cell.cell import Cell
from tacsim.sim.cell.description import FREE_HAND, TWO_FINGER_85, ArmDescription, ur5e_links
from tacsim.sim.cell.motion import DynamicMotion

UR5E_BEGIN = np.array([3.1, -1.2, 1.6, -1.97, -1.57, 0.0])
BOX = {"geometry": {"shape": "box", "size": [0.02, 0.014, 0.016]}}


def scene(thing: dict[str, Any] | None = None, **values: Any) -> Scene:
    """The box of 0.1 kg on a pedestal of 30 mm, with `thing` changed of it."""
    item = {**BOX, "pedestal": 0.03, **(thing or {})}
    return Scene.model_validate(
        {"name": "test", "body": None, "preset": "learn", "object": item, "gravity": (0, 0, -9.81), **values}
    )


def hand(of: Scene | None = None, starts: dict[str, Pose] | None = None, **gripper: Any) -> Cell:
    shape = replace(FREE_HAND, arm="hand", **gripper)
    return Cell(scene() if of is None else of, {"hand": ArmDescription()}, {"hand": shape}, starts=starts)


def ur5e_links_of_maker() -> Any:
    k = MODELS["ur5e"]
    return ur5e_links(k.a2, k.a3, k.d1, k.d4, k.d5, k.d6)


def ur5e(of: Scene | None = None) -> Cell:
    """A UR5e 0.45 m behind the object."""
    arm = ArmDescription(Pose(np.array([-0.45, 0.0, 0.0])), ur5e_links_of_maker(), begin=UR5E_BEGIN)
    return Cell(scene() if of is None else of, {"robot": arm}, {"hand": replace(TWO_FINGER_85, arm="robot")})


def let_pass(cell: Cell, seconds: float, targets: dict[str, Pose] | None = None, period: float = 0.05) -> None:
    """Whole periods; `targets` in each of them."""
    for _ in range(round(seconds / period)):
        DynamicMotion().advance(cell, targets or {}, period)


def above(pose: Pose, height: float) -> Pose:
    return Pose(pose.position + [0.0, 0.0, height], pose.quaternion)


CLAMP = """<mujoco model="clamp"><worldbody>
  <body name="column" pos="0 0 .3"><joint name="up" type="slide" axis="0 0 1" range="-.3 .3" limited="true"/>
    <joint name="side" type="slide" axis="1 0 0"/><joint name="out" type="slide" axis="0 1 0"/>
    <joint name="roll" type="hinge" axis="1 0 0"/><joint name="pitch" type="hinge" axis="0 1 0"/>
    <joint name="yaw" type="hinge" axis="0 0 1"/>
    <geom type="box" size=".02 .02 .02" mass="2" contype="0" conaffinity="0"/>
    <site name="mount" pos="0 0 -.02" quat="0 1 0 0"/>
    <body name="tip" pos="0 0 -.1">{fingers}<site name="grip" quat="0 1 0 0"/></body></body>
  </worldbody><actuator><position name="hold" joint="up" kp="1000"/></actuator></mujoco>"""
FINGER = """<body name="{side}"><joint name="{side}" type="slide" axis="{sign} 0 0"/>
  <inertial pos="0 0 0" mass=".2" diaginertia="1e-4 1e-4 1e-4"/>
  <site name="{side}_gel" quat="{quaternion}"/></body>"""
LEFT = FINGER.format(side="left", sign=-1, quaternion=".7071068 0 .7071068 0")
RIGHT = FINGER.format(side="right", sign=1, quaternion=".7071068 0 -.7071068 0")


def write_clamp(folder: Path, *, fingers: bool = True) -> Path:
    """An MJCF file of a column with six joints, of which a gripper hangs, with or without fingers of its own."""
    path = folder / "clamp.xml"
    path.write_text(CLAMP.format(fingers=LEFT + RIGHT if fingers else ""), encoding="utf-8")
    return path

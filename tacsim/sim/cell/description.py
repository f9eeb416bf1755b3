"""What a cell consists of, in addition to its scene: arms, grippers, cameras, with the maker's dimensions."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tacsim.interface import FloatArray, Pose


@dataclass(frozen=True, slots=True)
class Link:
    """One link of a serial arm, which turns about the z axis of its frame: its mass and its primitives, there.

    capsules: (from (3,), to (3,), radius) [m]. The transform to the frame of the next link is that of standard
    Denavit-Hartenberg parameters: along z by `d`, along x by `a`, about x by `alpha`.
    """

    a: float  # [m]
    d: float  # [m]
    alpha: float  # [rad]
    mass: float  # [kg]
    centre: tuple[float, float, float]  # of mass [m]
    max_torque: float  # [N m]
    max_speed: float  # [rad/s]
    capsules: tuple[tuple[tuple[float, float, float], tuple[float, float, float], float], ...]


@dataclass(frozen=True, slots=True, eq=False)
class ArmDescription:
    """An arm: a free flange, which reaches every commanded pose; a chain of links; or a model of the user.

    links: none for a free flange, and for a model of the user, whose `file`, `joints` and flange `site` count instead.
    begin: joints (n,) at the start, or near them [rad, m]; the joints of the start pose are found from there. None: as
    the model has them. armature: inertia of the motors, at the joints [kg m^2].
    """

    base: Pose = field(default_factory=Pose)  # world_from_base
    links: tuple[Link, ...] = ()
    file: Path | None = None
    joints: tuple[str, ...] = ()
    site: str = "flange"
    begin: FloatArray | None = None
    armature: float = 0.1


@dataclass(frozen=True, slots=True)
class GripperDescription:
    """A parallel gripper on the flange of an arm: two fingers that move alike, each with a gel; or, with `joints`, one
    of the user's arm model, whose joints [m] grow as the gripper opens.

    The tool, whose pose is that of its arm, lies between the pads: z away from the flange, along the fingers, x
    from the left to the right finger.
    """

    arm: str
    stroke: float  # largest distance between the pads [m]
    max_force: float  # [N]
    speed: float  # of each finger [m/s]
    length: float  # from the flange to the middle of the pads [m]
    body_mass: float  # [kg]
    finger_mass: float  # of each, its share of the motor's inertia included [kg]
    joints: tuple[str, str] | None = None  # of a model of the user: left, right
    tool: str | None = None  # its site between the pads
    pads: tuple[str, str] | None = None  # its sites of the pads


@dataclass(frozen=True, slots=True)
class ViewDescription:
    """A camera next to the cell."""

    position: tuple[float, float, float]  # world [m]
    target: tuple[float, float, float]  # world [m]
    field_of_view: float  # vertical [rad]
    size: tuple[int, int]  # width, height [px]


# UR5e: masses, centres of mass and torques of the maker ("DH Parameters for calculations of kinematics and dynamics",
# support article 16316; "Max. joint torques", article 17260). Radii are read from its drawings.
_UR5E_MASSES = (3.761, 8.058, 2.846, 1.37, 1.3, 0.365)  # [kg]
_UR5E_CENTRES = (
    (0.0, -0.02561, 0.00193), (0.2125, 0.0, 0.11336), (0.15, 0.0, 0.0265),
    (0.0, -0.0018, 0.01634), (0.0, 0.0018, 0.01634), (0.0, 0.0, -0.001159),
)  # of mass, in the frame at the end of each link [m]  # fmt: skip
_UR5E_SPEED = math.pi  # of each joint (user manual) [rad/s]
_UR5E_TORQUES = (150.0, 150.0, 150.0, 28.0, 28.0, 28.0)  # [N m]


def ur5e_links(a2: float, a3: float, d1: float, d4: float, d5: float, d6: float) -> tuple[Link, ...]:
    """The links of a UR5e with these Denavit-Hartenberg lengths [m]."""
    side, inner = 0.135, 0.015  # of the upper arm and the forearm, along the axis of the shoulder [m]
    rows = (
        (0.0, d1, math.pi / 2), (a2, 0.0, 0.0), (a3, 0.0, 0.0),
        (0.0, d4, math.pi / 2), (0.0, d5, -math.pi / 2), (0.0, d6, 0.0),
    )  # fmt: skip
    o = (0.0, 0.0, 0.0)
    capsules = (
        ((o, (0.0, 0.0, d1), 0.06),),
        (
            (o, (0.0, 0.0, side), 0.06), ((0.0, 0.0, side), (a2, 0.0, side), 0.052),
            ((a2, 0.0, 0.02), (a2, 0.0, side), 0.055),
        ),
        (((0.0, 0.0, inner), (a3, 0.0, inner), 0.045),),
        (((0.0, 0.0, -0.03), (0.0, 0.0, d4), 0.042),),
        (((0.0, 0.0, -0.03), (0.0, 0.0, d5), 0.042),),
        (((0.0, 0.0, 0.03), (0.0, 0.0, d6 - 0.03), 0.038),),
    )  # fmt: skip
    links = []
    for (a, d, alpha), mass, centre, torque, shape in zip(
        rows, _UR5E_MASSES, _UR5E_CENTRES, _UR5E_TORQUES, capsules, strict=True
    ):
        turn = np.array([[1, 0, 0], [0, math.cos(alpha), -math.sin(alpha)], [0, math.sin(alpha), math.cos(alpha)]])
        x, y, z = (turn @ np.array(centre) + [a, 0.0, d]).tolist()
        links.append(Link(a, d, alpha, mass, (x, y, z), torque, _UR5E_SPEED, shape))
    return tuple(links)


# 2F-85: stroke, force, speed and mass of the maker's data sheet ("2F-85 and 2F-140 instruction manual", section 6). The
# length is that to the middle of the pads. Fingers are heavier than they look, since they carry the motor's inertia
# through its gears.
TWO_FINGER_85 = GripperDescription(
    arm="", stroke=85e-3, max_force=235.0, speed=75e-3, length=0.16, body_mass=0.725, finger_mass=0.5
)
# A light gripper without a model in the world: two slides with force control from 0 N up.
FREE_HAND = GripperDescription(
    arm="", stroke=60e-3, max_force=60.0, speed=75e-3, length=0.12, body_mass=0.4, finger_mass=0.3
)

"""Grips of one object between two pads that face each other along x."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tacsim.models.material import GelMaterial
from tacsim.models.scene import Box, Gel, Shape, Sphere
from tacsim.physics.grip.model import HeldObject, HeldStates, facing_pads
from tacsim.physics.grip.tuning import EARTH
from tacsim.physics.grip.world import GripWorld

BOX, BALL = Box(size=(20e-3, 12e-3, 16e-3)), Sphere(radius=10e-3)
HOME = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
GAP = 0.2e-3  # between each pad and the object at the start [m]


def make_grip(
    *items: HeldObject, gravity: tuple[float, ...] = EARTH, modulus: float = 0.145e6, preset: str = "learn",
    housing: float | None = None,
) -> GripWorld:  # fmt: skip
    """Grips of objects 20 mm wide, the pads clear of them."""
    gel = Gel(material=GelMaterial(youngs_modulus=modulus), housing=housing)
    world = GripWorld(items, gel, preset=preset, gravity=gravity)  # type: ignore[arg-type]
    world.reset(np.tile(HOME, (len(items), 1)), pads_at(count=len(items)))
    return world


def pads_at(gap: float = GAP, count: int = 1, pose: np.ndarray = HOME) -> np.ndarray:
    """(count, 2, 7) of pads with a gap to an object 20 mm wide, negative when closed."""
    return np.tile(facing_pads(pose, 20e-3 + 2 * gap), (count, 1, 1))


def held(
    geometry: Shape = BOX, mass: float = 0.1, force: float = 4.0, **options: object
) -> tuple[GripWorld, HeldStates]:
    world = make_grip(HeldObject(geometry, mass), **options)  # type: ignore[arg-type]
    return world, world.grasp(pads_at(), [force])


def total_force(states: HeldStates, index: int = 0) -> np.ndarray:
    """(3,) force on all pads of a grip, world axes [N]."""
    turns = Rotation.from_quat(states.pads[index, :, 3:])
    return np.asarray(turns.apply(states.wrenches[index, :, :3]).sum(axis=0))

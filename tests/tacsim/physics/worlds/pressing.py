"""A world with an indenter on a gel, and a motion that must come to rest."""

import numpy as np

from tacsim.interface import Pose
from tacsim.models.material import GelMaterial
from tacsim.models.scene import Gel, Indenter, Scene, Shape
from tacsim.physics.worlds.press import PressWorld


def world(
    geometry: Shape, friction: float = 0.6, tolerance: float = 1e-3, edge_radius: float = 0.0, **scene: object
) -> PressWorld:
    return PressWorld(
        Scene.model_validate(
            {
                "body": None,
                "indenter": Indenter(geometry=geometry, friction=friction, edge_radius=edge_radius),
                "gel": Gel(material=GelMaterial(poisson_ratio=0.45)),
                "settling": {"tolerance": tolerance},
                **scene,
            }
        )
    )


def move(w: PressWorld, by: tuple[float, float, float], turn: float = 0.0) -> None:
    pose = w.pose("indenter")
    quaternion = np.array([0, 0, np.sin(turn / 2), np.cos(turn / 2)])
    stats = w.move({"indenter": Pose(pose.position + by, quaternion)})
    assert stats.settled, stats

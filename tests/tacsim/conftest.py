"""A world that is known in closed form, and rigs on it: two gels as springs round a body that is a spring."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import pytest

from robot.open import open_rig
from tacsim.config import load_rig
from tacsim.interface import Pose, Truth
from tacsim.models.scene import GelSurface, Scene
from tacsim.physics.move import MoveStats
from tacsim.rig import Rig

HEIGHT, RADIUS, GAP = 10e-3, 0.25e-3, 0.5e-3  # of the body; of a particle; between gel and body at first [m]
GEL, BODY = 5e3, 5e3  # stiffness of one gel and of the body [N/m]
LAG = 0.4  # the body follows the upper sensor but for this part of the first millimetre
SMALL = (
    "sensors.lower.model.geometry.width=40",
    "sensors.lower.model.geometry.height=30",
    "sensors.lower.model.geometry.pixel_pitch=0.4 mm",
    "sensors.upper.model.geometry.width=40",
    "sensors.upper.model.geometry.height=30",
    "sensors.upper.model.geometry.pixel_pitch=0.4 mm",
    "canonical.rows=16",
    "canonical.columns=16",
    "canonical.pitch=1 mm",
    "canonical.image_scale=1",
)


class SpringWorld:
    """Three springs in a row along world z: lower gel, body, upper gel.

    Sideways the body follows the upper sensor with a lag that grows to LAG mm. What the body lived through is part of
    its state: `worst` is the largest force it ever felt.
    """

    sensors = ("lower", "upper")

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.durations: list[float | None] = []
        self.flows: list[bool] = []
        self.moves: list[dict[str, Pose]] = []  # every call of move
        self.worst = 0.0
        self.poses = {
            "lower": Pose(),
            "upper": Pose(np.array([0.0, 0.0, HEIGHT + 2 * GAP]), np.array([1.0, 0.0, 0.0, 0.0])),
        }

    def pose(self, name: str) -> Pose:
        return self.poses[name]

    def place(self, poses: Mapping[str, Pose]) -> None:
        self.poses |= poses

    def move(
        self, targets: Mapping[str, Pose], loads: None = None, duration: float | None = None, *, flow: bool = False
    ) -> MoveStats:
        self.durations.append(duration)
        self.flows.append(flow)
        self.moves.append(dict(targets))
        self.poses |= targets
        self.worst = max(self.worst, self.force)
        return MoveStats(
            substeps=30, hold=10, residual=0.001, settled=not (flow and targets), overlap=0.0, guard_hits=0
        )

    @property
    def force(self) -> float:
        gap = self.poses["upper"].position[2] - self.poses["lower"].position[2]
        return max(0.0, (HEIGHT - gap) / (2 / GEL + 1 / BODY))

    @property
    def aside(self) -> np.ndarray:
        """(2,) of the body [m]"""
        way = self.poses["upper"].position[:2]
        length = float(np.linalg.norm(way))
        lag = LAG * 1e-3 * (1 - np.exp(-length / 1e-3))
        return way * (1 - lag / length) if length > 0 else way

    def wrench(self, name: str) -> np.ndarray:
        """The normal force acts under the body's middle."""
        force = self.force
        x, y = self.aside - self.poses[name].position[:2]
        y = y if name == "lower" else -y  # the upper sensor is half-turned about x
        return np.array([0.0, 0.0, -force, -y * force, x * force, 0.0])

    def surface(self, name: str) -> GelSurface:
        lattice = (np.arange(21) - 10) * 1e-3
        under = (np.abs(lattice[:, None]) <= 5e-3) & (np.abs(lattice[None, :]) <= 5e-3)
        displacement = np.zeros((21, 21, 3), np.float32)
        displacement[..., 2] = -np.where(under, self.force / GEL, 0.0)
        return GelSurface(displacement, 1e-3, (-10e-3, -10e-3))

    def truth(self) -> Truth:
        height = HEIGHT - self.force / BODY
        middle = np.mean([pose.position[2] for pose in self.poses.values()])
        half = np.array([5e-3, 5e-3, height / 2]) - RADIUS
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
        centre = np.array([*self.aside, middle])
        return Truth(height, centre, (corners + centre).astype(np.float32), dict(self.poses))

    def snapshot(self) -> dict[str, np.ndarray]:
        poses = np.array([[*pose.position, *pose.quaternion] for pose in self.poses.values()])
        return {"poses": poses, "worst": np.array(self.worst)}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        self.poses = {name: Pose(p[:3], p[3:]) for name, p in zip(self.sensors, state["poses"], strict=True)}
        self.worst = float(state["worst"])


@pytest.fixture
def spring_world() -> SpringWorld:
    return SpringWorld(Scene())


@pytest.fixture
def open_springs(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Rig]]:
    """Opens the rig `sim` on a SpringWorld, with small pictures; `rig.world` is that world."""
    opened: list[Rig] = []

    def open_one(task: str = "squeeze", *overrides: str) -> Any:
        worlds: list[SpringWorld] = []

        def make(scene: Scene) -> SpringWorld:
            worlds.append(SpringWorld(scene))
            return worlds[-1]

        monkeypatch.setattr("robot.rig.sim_rig.make_world", make)
        rig = open_rig(load_rig("sim", task=task, overrides=[*SMALL, *overrides]))
        rig.world = worlds[-1]  # type: ignore[attr-defined]
        opened.append(rig)
        return rig

    yield open_one
    for rig in opened:
        rig.close()

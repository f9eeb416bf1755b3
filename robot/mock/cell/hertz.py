"""Replacement of the simulated cell: a rigid ball in front of each sensor, with the contact in closed form.

Unlike the simulator it is fast enough for real time: for tests of timing (`tacsim calibrate latency` on mocks).
Hertz's contact of a ball with an elastic half-space (Johnson, Contact Mechanics, 1985, 3.4 and 4.2): radius a with
a^2 = R d, force F = 4/3 E* sqrt(R) d^1.5 with E* = E / (1 - nu^2), surface deflection

    u(r) = d - r^2 / 2R                                                  r < a
    u(r) = ((2 a^2 - r^2) asin(a / r) + a sqrt(r^2 - a^2)) / (pi R)      r >= a

There is no friction, no tilt of the dent, no body and no ground truth: tasks need the simulator.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from itertools import count

import numpy as np
from numpy.typing import NDArray

from tacsim import pose as se3
from tacsim.interface import FloatArray, Pose, SurfaceMap
from tacsim.models.scene import GelSurface, Scene
from tacsim.models.sensor import CanonicalGrid, SensorModel
from tacsim.optics.noise import noise_source
from tacsim.optics.render import Renderer
from tacsim.optics.surface import surface_map

BALL_RADIUS = 4e-3  # of the balls [m]
BALL_GAP = 0.2e-3  # between gel and ball at the start: two balls, one above the other, between two gels [m]
POSITION_STEP = 10e-6  # contacts are rounded to this step, so that images can be cached [m]
MAX_CACHED_IMAGES = 512  # images that are kept for reuse


class HertzCell:
    """Replaces the world in the simulator's process: poses of the sensors, the balls, and their images.

    Raises ValueError for a sensor that is not in the scene.
    """

    def __init__(self, scene: Scene, models: Mapping[str, SensorModel], grid: CanonicalGrid) -> None:
        unknown = sorted(set(models) - set(scene.sensors))
        if unknown:
            raise ValueError(f"scene '{scene.name}' has no sensor '{unknown[0]}'; it has {', '.join(scene.sensors)}")
        self._grid, self._models = grid, dict(models)
        self._gels = {name: scene.gel_of(name) for name in scene.sensors}
        above = Pose(np.array([0.0, 0.0, 4 * BALL_RADIUS + 2 * BALL_GAP]), np.array([1.0, 0.0, 0.0, 0.0]))
        self._poses = {name: above if name == "upper" else Pose() for name in scene.sensors}
        ahead = Pose(np.array([0.0, 0.0, BALL_RADIUS + BALL_GAP]))
        self._balls = {name: se3.compose(pose, ahead).position for name, pose in self._poses.items()}
        self._renderers = {name: Renderer(model, scene.gel_of(name).size[:2]) for name, model in models.items()}
        self._noise = {name: noise_source(model, name) for name, model in models.items()}
        self._pictures = count()
        self._drawn = lru_cache(MAX_CACHED_IMAGES)(self._draw)
        self.stats: Mapping[str, float] = {}  # a closed form has no iterations

    def truth(self) -> None:
        """None: there is no body."""

    def poses(self) -> dict[str, Pose]:
        """world_from_sensor of each."""
        return dict(self._poses)

    def place(self, poses: Mapping[str, Pose]) -> None:
        """Moves the sensors; the balls are fixed."""
        self.move(poses)

    def move(self, poses: Mapping[str, Pose]) -> None:
        """Raises ValueError for a ball that would pass through the gel; then the sensors do not move."""
        moved = {**self._poses, **poses}
        for name, ball in self._balls.items():
            depth, thickness = _contact(moved[name], ball)[0], self._gels[name].size[2]
            if depth >= thickness:
                raise ValueError(
                    f"sensor '{name}' is pressed {1e3 * depth:.2f} mm into a ball, its gel is "
                    f"{1e3 * thickness:g} mm thick"
                )
        self._poses = moved

    def wrench(self, name: str) -> FloatArray:
        """Wrench (6,) on the sensor, about its origin, its axes [N, N m]: the ball pushes along -z."""
        depth, x, y = _contact(self._poses[name], self._balls[name])
        material = self._gels[name].material
        modulus = material.youngs_modulus / (1.0 - material.poisson_ratio**2)
        force = 4.0 / 3.0 * modulus * np.sqrt(BALL_RADIUS) * max(0.0, depth) ** 1.5
        return np.array([0.0, 0.0, -force, -y * force, x * force, 0.0])

    def render(self, name: str) -> tuple[NDArray[np.uint8], SurfaceMap]:
        """Image (H, W, 3) and surface of a sensor."""
        depth, x, y = _contact(self._poses[name], self._balls[name])
        # Without touch the image does not depend on the position of the ball.
        place = (depth, x, y) if depth > 0.0 else (0.0, 0.0, 0.0)
        image, surface = self._drawn(name, *(round(value / POSITION_STEP) for value in place))
        noise = self._noise[name]
        return image if noise is None else noise(image, next(self._pictures)), surface

    def _draw(self, name: str, *steps: int) -> tuple[NDArray[np.uint8], SurfaceMap]:
        """The image without noise, and the surface, with the ball at depth, x, y = POSITION_STEP * steps [m]."""
        depth, x, y = (POSITION_STEP * step for step in steps)
        surface = dent(self._gels[name].size[:2], depth, x, y)
        return self._renderers[name](surface), surface_map(surface, self._grid, self._models[name].markers)


def _contact(sensor: Pose, ball: FloatArray) -> tuple[float, float, float]:
    """Depth of a ball in the gel, negative in front of it, and its position x, y on the gel [m]."""
    x, y, z = se3.transform(se3.inverse(sensor), ball).tolist()
    return BALL_RADIUS - z, x, y


def dent(size: tuple[float, float], depth: float, x: float, y: float) -> GelSurface:
    """The surface of a gel of `size` (x, y) [m] into which a ball of BALL_RADIUS is pressed by `depth` at x, y [m]."""
    spacing = 0.25e-3  # of the nodes of the surface [m]
    counts = [round(length / spacing) + 1 for length in size]
    axes = [np.linspace(-length / 2, length / 2, count) for length, count in zip(size, counts, strict=True)]
    r = np.hypot(*np.meshgrid(axes[0] - x, axes[1] - y, indexing="ij"))
    displacement = np.zeros((*counts, 3), np.float32)
    if depth > 0.0:
        a = np.sqrt(BALL_RADIUS * depth)
        far = np.maximum(r, a)
        outside = ((2 * a**2 - far**2) * np.arcsin(a / far) + a * np.sqrt(far**2 - a**2)) / (np.pi * BALL_RADIUS)
        displacement[..., 2] = -np.where(r < a, depth - r**2 / (2 * BALL_RADIUS), outside)
    return GelSurface(displacement, spacing, (-size[0] / 2, -size[1] / 2))

"""A gel on a mock arm that touches a fixed ball: where the sensor really sits is known only here."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from robot.mock import MockCamera, MockState
from tacsim import pose as se3
from tacsim.interface import Pose
from tacsim.models.scene import GelSurface
from tacsim.models.sensor import SensorModel
from tacsim.optics.render import Renderer
from tests.robot.procedures.seen_arm import SeenArm

GEL = (16e-3, 16e-3)  # [m]
SPACING = 0.25e-3


class BallOnPost(SeenArm):
    """While open, draws what the camera in the gel sees of the ball where the arm rests.

    No picture comes while it moves, nor before the new one is drawn: none of another pose is taken for it, however slow
    the machine is.

    host: of the mock controller, whose TCP is the flange; base_from_ball: (3,) [m]; flange_from_sensor: the truth.
    """

    def __init__(
        self,
        host: str,
        camera: MockCamera,
        model: SensorModel,
        flange_from_sensor: Pose,
        base_from_ball: np.ndarray,
        ball_radius: float,
    ) -> None:
        super().__init__(host, camera)
        self._sensor, self._ball, self._radius = flange_from_sensor, base_from_ball, ball_radius
        self._render = Renderer(model, GEL)
        axis = SPACING * (np.arange(round(GEL[0] / SPACING) + 1)) - GEL[0] / 2
        self._x, self._y = np.meshgrid(axis, axis, indexing="ij")
        self._shown: tuple[float, ...] | None = None  # the pose of the TCP that the picture belongs to
        self.deepest = 0.0  # that the gel was pressed [m]
        camera.push(self.picture(0.0, 0.0, -1e-3))

    def picture(self, x: float, y: float, depth: float) -> np.ndarray:
        """The gel with the ball `depth` [m] in it at x, y [m]: a ball's cap, and a soft skirt round it."""
        r = np.hypot(self._x - x, self._y - y)
        dent = np.zeros_like(r)
        if depth > 0:
            contact = np.sqrt(self._radius * depth)
            q = np.maximum(r / contact, 1.0)
            skirt = depth / np.pi * ((2 - q * q) * np.arcsin(1 / q) + np.sqrt(q * q - 1))
            inside = depth - self._radius + np.sqrt(np.maximum(self._radius**2 - r**2, 0.0))
            dent = np.where(r < contact, inside, skirt * np.exp(-np.maximum(r - contact, 0.0) / 1e-3))
        values = np.zeros((*r.shape, 3), dtype=np.float32)
        values[..., 2] = -dent
        return self._render(GelSurface(values, SPACING, (-GEL[0] / 2, -GEL[1] / 2)))

    def draw(self, state: MockState) -> None:
        flange = Pose(np.array(state.pose[:3]), Rotation.from_rotvec(state.pose[3:]).as_quat())
        x, y, z = se3.transform(se3.inverse(se3.compose(flange, self._sensor)), self._ball)
        self.deepest = max(self.deepest, self._radius - z)
        if not state.rests or state.pose != self._shown:
            self._camera.stall(True)
            self._shown = None
            if state.rests:
                self._camera.push(self.picture(x, y, self._radius - z))
                self._camera.stall(False)
                self._shown = state.pose

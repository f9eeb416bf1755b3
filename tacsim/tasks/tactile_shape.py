"""The shape of a body that rolls between two gels, as far as they have felt it."""

from __future__ import annotations

from collections import deque

import numpy as np

from tacsim import pose as se3
from tacsim.interface import ArmState, FloatArray, Observation, TactileObservation
from tacsim.models.sensor import CanonicalGrid
from tacsim.optics.grid import canonical_cells

MAX_TOUCHES = 60  # touches; what was felt before has been kneaded since
POINTS = 150  # kept of a touch
CELLS = 1500  # of the box round the shape
MIN_DEPTH_SHARE = 0.05  # of the greatest depth: less is the gel's own slope, or noise


class TactileShape:
    """Gathers the points of the body's surface that the gels `lower` and `upper` touch, in axes that turn with it.

    A body that neither gel slides on turns by (way of one gel over the other) / (its height); the wider its contact is
    along the way, the less, since a slab is sheared instead: 1 / (1 + (width / height)^4) of it. What is felt again
    flattens what was felt there before. The shape is the convex hull of all points, stretched sideways to the body's
    volume [m^3], which is known.
    """

    def __init__(self, volume: float, canonical: CanonicalGrid) -> None:
        self._volume, self._cells = volume, canonical_cells(canonical).points()
        self._touches: deque[FloatArray] = deque(maxlen=MAX_TOUCHES)  # (n, 3) each, body axes, from its middle [m]
        self._world_from_body = np.eye(3)
        self._before: FloatArray | None = None  # (2,) from the lower sensor to the upper, at the last touch [m]

    def add_observation(self, observation: Observation) -> None:
        """The next observation. Raises ValueError for a sensor without height."""
        below, above = (self._contact_points(observation.tactile[n], observation.arms[n]) for n in ("lower", "upper"))
        if not len(below) or not len(above):
            self._before = None  # where it turns to now cannot be felt
            return
        bottom, top = float(below[:, 2].min()), float(above[:, 2].max())
        height = max(top - bottom, 1e-6)
        lower, upper = (observation.arms[name].pose.position[:2] for name in ("lower", "upper"))
        if self._before is not None:
            self._rotate_body(upper - lower - self._before, below, above, height)
        self._before = upper - lower
        up = self._world_from_body[2]  # in body axes
        for touch in self._touches:
            beyond = touch @ up
            touch -= np.outer(beyond - np.clip(beyond, -height / 2, height / 2), up)
        middle = np.array([*(below.mean(axis=0) + above.mean(axis=0))[:2], bottom + top]) / 2
        tactile_estimate = np.concatenate([below, above]) - middle
        self._touches.append(tactile_estimate[:: len(tactile_estimate) // POINTS + 1] @ self._world_from_body)

    def points(self) -> FloatArray | None:
        """(n, 3) that fill the shape, world axes, from their mean [m]; None where not enough has been felt."""
        from scipy.spatial import ConvexHull, QhullError

        if not self._touches:
            return None
        tactile_estimate = np.concatenate(self._touches)
        try:
            hull = ConvexHull(tactile_estimate)
        except QhullError:
            return None
        lowest, size = tactile_estimate.min(axis=0), np.ptp(tactile_estimate, axis=0)
        spacing = (size.prod() / CELLS) ** (1 / 3)
        axes = [np.arange(spacing / 2, length, spacing) for length in size]
        cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) + lowest
        inside = (cells @ hull.equations[:, :3].T + hull.equations[:, 3] <= 0.0).all(axis=1)
        if not inside.any():
            return None
        lateral_scale = (self._volume / hull.volume) ** 0.5
        shape = cells[inside] @ self._world_from_body.T * [lateral_scale, lateral_scale, 1.0]
        centred: FloatArray = shape - shape.mean(axis=0)
        return centred

    def _contact_points(self, touch: TactileObservation, arm: ArmState) -> FloatArray:
        """(n, 3) where the gel touches the body, world [m]."""
        if touch.height is None:
            raise ValueError("the shape of a body is felt by the gel's height, and this sensor delivers none")
        deepest = float(touch.height.max(where=touch.valid, initial=0.0))
        pressed = touch.contact & (touch.height > MIN_DEPTH_SHARE * deepest)
        return se3.transform(arm.pose, np.column_stack([self._cells[pressed], -touch.height[pressed]]))

    def _rotate_body(self, displacement: FloatArray, below: FloatArray, above: FloatArray, height: float) -> None:
        """By the way (2,) that the upper gel has moved over the lower [m]."""
        length = float(np.linalg.norm(displacement))
        if length == 0.0:
            return
        # Of evenly spread points the width is sqrt(12) times the deviation.
        width = np.sqrt(3.0) * sum(float((points[:, :2] @ (displacement / length)).std()) for points in (below, above))
        angle = length / height / (1.0 + (width / height) ** 4)
        turned = se3.from_rotation_vector(
            np.zeros(3), np.array([-displacement[1], displacement[0], 0.0]) * (angle / length)
        )
        self._world_from_body = se3.rotate(turned, self._world_from_body.T).T

"""Knead: make a rod or a ball of the body, the gels as hands: both sensors along world z, the upper one in x, y.

The distance from the goal is how far the body is from a solid of equal volume: Chamfer and earth mover's distance,
intersection over union. A body is a cloud of particles (n, 3) [m], each of the volume V / n. It is compared with its
centre of mass at the solid's. Of the three measures Huang et al. 2021 (PlasticineLab) report the IoU, Lin et al. 2022
(DiffSkill) the earth mover's distance on 500 points, Shi et al. 2023 (RoboCook) Chamfer's and the earth mover's.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from tacsim import pose as se3
from tacsim.geometry import shapes
from tacsim.interface import Action, ArmState, FloatArray, Needs, Observation, Policy, Pose, TactileObservation, Truth
from tacsim.models.scene import Cylinder, Sphere
from tacsim.models.sensor import CanonicalGrid
from tacsim.models.task import KneadConfig
from tacsim.optics.grid import canonical_cells
from tacsim.tasks.squeeze import BOTH, estimated_height
from tacsim.tasks.task import Axis, Estimator, GoalOutOfReach, Task
from tacsim.tasks.tuning import (
    ARRIVAL_SHARE,
    BALL_CIRCLE_SHARE,
    BALL_HEIGHT_SHARE,
    CLOSING_STEPS,
    MAX_PRESSURE_SHARE,
    MAX_TOUCHES,
    MIN_TOUCH_DEPTH,
)

SAMPLE_POINTS = 500  # of the earth mover's distance


@dataclass(frozen=True)
class Solid:
    """A ball, or a rod (a cylinder) along world x, that a body is to become."""

    geometry: Sphere | Cylinder

    @staticmethod
    def make_ball(volume: float) -> Solid:
        return Solid(Sphere(radius=(3.0 * volume / (4.0 * np.pi)) ** (1 / 3)))

    @staticmethod
    def make_rod(volume: float, slenderness: float) -> Solid:
        """slenderness: length over diameter."""
        radius = (volume / (2.0 * np.pi * slenderness)) ** (1 / 3)
        return Solid(Cylinder(radius=radius, height=2.0 * radius * slenderness))

    @property
    def size(self) -> FloatArray:
        """(3,) along world x, y, z [m]."""
        size: FloatArray = shapes.bounding_size(self.geometry)[[2, 1, 0]]
        return size

    def distance(self, points: FloatArray) -> FloatArray:
        """Signed distance (n,) of points (n, 3), world axes, from its middle [m]; negative inside."""
        distance: FloatArray = shapes.shape_distance(self.geometry, points[:, [2, 1, 0]])
        return distance

    @cached_property
    def points(self) -> FloatArray:
        """Points (n, 3) that fill it evenly, world axes, from its middle [m]."""
        cells_across = 12  # particles of a target across its diameter
        spacing = 2.0 * self.geometry.radius / cells_across
        points: FloatArray = shapes.lattice_particles(self.geometry, spacing)[:, [2, 1, 0]]
        return points

    @cached_property
    def sample_points(self) -> FloatArray:
        """(POINTS, 3) of `points`."""
        points: FloatArray = select_evenly(self.points)
        return points


def centre_points(points: ArrayLike) -> FloatArray:
    """Points from their mean."""
    given = np.asarray(points, dtype=np.float64)
    moved: FloatArray = given - given.mean(axis=0)
    return moved


def chamfer_distance(body: FloatArray, solid: Solid, volume: float) -> float:
    """Mean of how far the body's particles lie outside the solid, and how far the solid's points lie from the body [m].

    Each particle covers the points that are no farther than half the diagonal of its cube, so that a body that fills
    the solid is at 0.
    """
    from scipy.spatial import KDTree  # here: other tasks start without SciPy, 0.3 s earlier

    outside = np.maximum(solid.distance(body), 0.0).mean()
    reach = 0.5 * np.sqrt(3.0) * (volume / len(body)) ** (1 / 3)
    bare = np.maximum(KDTree(body).query(solid.points)[0] - reach, 0.0).mean()
    return float(0.5 * (outside + bare))


def earth_movers_distance(one: FloatArray, other: FloatArray) -> float:
    """Smallest mean distance by which the points of one cloud must move to become the other, of as many points [m]."""
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial.distance import cdist

    distances = cdist(one, other)
    return float(distances[linear_sum_assignment(distances)].mean())


def select_evenly(points: FloatArray, number: int = SAMPLE_POINTS) -> FloatArray:
    """(number, 3) of the points, the same ones each time; some twice where there are too few."""
    order = np.random.default_rng(0).permutation(len(points))
    return points[np.resize(order, number)]


def intersection_over_union(body: FloatArray, solid: Solid) -> float:
    """Intersection over union of the two, which have the same volume [-]: of a share f of the body that lies inside the
    solid, f / (2 - f)."""
    inside = float((solid.distance(body) <= 0.0).mean())
    return inside / (2.0 - inside)


@dataclass(frozen=True)
class Knead(Task):
    """distance = Chamfer's between the body and the solid, both at one place."""

    config: KneadConfig

    def require_reachable(self, start: Truth) -> None:
        scene = self.config.scene
        narrowest = np.min([scene.gel_of(name).size[:2] for name in scene.sensors], axis=0)
        for wanted, there, axis in zip(self.goal[:2], narrowest.tolist(), "xy", strict=True):
            if wanted > there:
                raise GoalOutOfReach(
                    f"task: the {self.config.shape} would be {1e3 * wanted:.3g} mm long along {axis}, the gels are "
                    f"{1e3 * there:g} mm; give it less slenderness, or a smaller body"
                )

    @property
    def touch_needs(self) -> Needs:
        return Needs(BOTH, BOTH, height=True)

    @property
    def axes(self) -> tuple[Axis, ...]:
        return (
            Axis("lower", (0.0, 0.0, 1.0)),
            Axis("upper", (0.0, 0.0, 1.0)),
            Axis("upper", (1.0, 0.0, 0.0)),
            Axis("upper", (0.0, 1.0, 0.0)),
        )

    @property
    def goal(self) -> tuple[float, ...]:
        """Size of the solid along world x, y, z [m]."""
        return tuple(float(side) for side in self.solid.size)

    @cached_property
    def volume(self) -> float:
        """Of the body [m^3]."""
        body = self.config.scene.body
        if body is None:
            raise ValueError("task 'knead' needs a scene with a body, whose volume its solid has")
        return shapes.enclosed_volume(body.geometry)

    @cached_property
    def solid(self) -> Solid:
        rod = self.config.shape == "rod"
        return Solid.make_rod(self.volume, self.config.slenderness) if rod else Solid.make_ball(self.volume)

    def distance(self, truth: Truth, start: Truth) -> float:
        return chamfer_distance(centre_points(truth.points), self.solid, self.volume)

    def measures(self, truth: Truth, start: Truth) -> Mapping[str, float]:
        """How alike body and solid are in other words: `earth_movers` [m], `iou` [-], and of each the improvement
        since `start`: 0 none (or worse), 1 all."""
        now, then = (self._shape_measures(each) for each in (truth, start))
        better = {
            "chamfer": 1.0 - now["chamfer"] / then["chamfer"],
            "earth_movers": 1.0 - now["earth_movers"] / then["earth_movers"],
            "iou": (now["iou"] - then["iou"]) / (1.0 - then["iou"]),
        }
        return now | {f"{name}_improvement": max(0.0, share) for name, share in better.items()}

    def _shape_measures(self, truth: Truth) -> dict[str, float]:
        body = centre_points(truth.points)
        return {
            "chamfer": chamfer_distance(body, self.solid, self.volume),
            "earth_movers": earth_movers_distance(select_evenly(body), self.solid.sample_points),
            "iou": intersection_over_union(body, self.solid),
        }

    def estimator(self, canonical: CanonicalGrid) -> Estimator:
        shape = TactileShape(self.volume, canonical)

        def tactile_estimate(observation: Observation) -> float | None:
            shape.add_observation(observation)
            points = shape.points()
            return None if points is None else chamfer_distance(points, self.solid, self.volume)

        return tactile_estimate

    def scripted(self, *, through: bool = False) -> Policy:
        return ScriptedKnead(self, through)

    def analytic(self) -> Policy:
        return AnalyticKnead(self, False)

    def teacher(self) -> Policy:
        body = self.config.scene.body
        yields = None if body is None else body.material.yield_stress
        return ScriptedKnead(self, False) if yields is None else KneadTeacher(self, False, MAX_PRESSURE_SHARE * yields)


class ScriptedKnead:
    """Rolls the body between the gels at a light normal force: for a rod across its axis, a quarter turn to each side,
    for a ball on a circle. It lets go when the estimated height is that of the solid; with `through` it goes on
    rolling.

    pressure: the force that it holds, over the face of a cube of the body's volume [Pa]. Well below the yield stress it
    kneads nothing; clay that is pressed harder is flattened, not rolled.
    """

    gain = 0.05e-3  # correction of the height for a newton too little or too much [m/N]

    def __init__(self, task: Knead, through: bool, pressure: float = 12e3) -> None:
        self._task, self._through = task, through
        self._force = pressure * task.volume ** (2 / 3)
        self._is_ball = task.config.shape == "ball"
        # Clay between the gels springs back: a ball is rolled a little flatter than it is to become.
        self._goal_height = (BALL_HEIGHT_SHARE if self._is_ball else 1.0) * task.goal[2]
        # The body turns by half of the sensor's displacement over its own radius.
        self._reach = 0.5 * np.pi * task.goal[2]
        self._start: FloatArray | None = None
        self._before = 0.0

    @property
    def needs(self) -> Needs:
        return Needs(BOTH, BOTH, height=True)

    def reset(self) -> None:
        self._start = None
        self._before = 0.0

    def __call__(self, observation: Observation) -> Action:
        lower, upper = observation.arms["lower"], observation.arms["upper"]
        if self._start is None:
            self._start = np.array(upper.pose.position)
        closing = self._closing_step(observation)
        moved = upper.pose.position[:2] - self._start[:2]
        lateral = self._circle_step(moved) if self._is_ball else self._stroke_step(moved)
        return Action(
            {
                "lower": Pose(lower.pose.position + [0.0, 0.0, closing], lower.pose.quaternion),
                "upper": Pose(upper.pose.position + [*lateral, -closing], upper.pose.quaternion),
            }
        )

    def _closing_step(self, observation: Observation) -> float:
        """How far each sensor goes towards the other [m]."""
        if not self._through and estimated_height(observation) <= self._goal_height:
            return -0.2 * self._task.config.max_step
        return self._force_step(observation)

    def _force_step(self, observation: Observation) -> float:
        """As `_closing_step`, to the force that it holds."""
        longest = self._task.config.max_step
        force = -0.5 * float(observation.arms["lower"].wrench[2] + observation.arms["upper"].wrench[2])
        return float(np.clip(self.gain * (self._force - force), -longest, longest))

    def _stroke_step(self, now: FloatArray) -> FloatArray:
        """(2,) step of the upper sensor along y, `now` its lateral distance from where it began [m]: to one side, the
        other, and back to the middle. It depends on the sensor's motion, not on a clock, so a learner can see it."""
        aims = (1.0, -1.0, 0.0)  # of a stroke: to one side, to the other, to the middle
        longest, place = self._task.config.max_step, float(now[1])
        moved, self._before = place - self._before, place
        part = 1 if moved < -ARRIVAL_SHARE * longest else 2 if place < 0 else 0
        while np.linalg.norm(left := np.array([0.0, aims[part] * self._reach]) - now) < ARRIVAL_SHARE * longest:
            part = (part + 1) % 3
        step: FloatArray = left * min(1.0, 0.9 * longest / float(np.linalg.norm(left)))
        return step

    def _circle_step(self, now: FloatArray) -> FloatArray:
        """The same on a circle around the start, to which it spirals out: the body rolls about ever other axes."""
        longest, radius = 0.9 * self._task.config.max_step, BALL_CIRCLE_SHARE * self._task.goal[2]
        distance = float(np.linalg.norm(now))
        outwards = now / distance if distance > 0.0 else np.array([1.0, 0.0])
        onwards = np.array([-outwards[1], outwards[0]])
        if distance < radius - longest:
            spiral: FloatArray = longest * (outwards + onwards) / np.sqrt(2.0)
            return spiral
        angle = longest / radius
        left = radius * (np.cos(angle) * outwards + np.sin(angle) * onwards) - now
        step: FloatArray = left * min(1.0, longest / float(np.linalg.norm(left)))
        return step


class AnalyticKnead(ScriptedKnead):
    """Rolls to and fro, and closes by a fixed share of the height that is left to the solid's."""

    def _closing_step(self, observation: Observation) -> float:
        longest = self._task.config.max_step
        left = estimated_height(observation) - self._goal_height
        return float(np.clip(0.5 * left / CLOSING_STEPS, -longest, longest))


class KneadTeacher(ScriptedKnead):
    """Knows how much clay there is and how hard it is. Its closing speed is proportional to the distance of
    the height from the solid's, and it stays there. `pressure` is only a limit."""

    def _closing_step(self, observation: Observation) -> float:
        left = estimated_height(observation) - self._goal_height
        return min(self._force_step(observation), 0.5 * left / CLOSING_STEPS)


class TactileShape:
    """Gathers the points of the body's surface that the gels `lower` and `upper` touch, in axes that turn with it.

    A body that neither gel slides on turns by (displacement of one gel over the other) / (its height). A body with a
    wide contact along the displacement turns less, since a slab is sheared instead: by 1 / (1 + (width / height)^4) of
    it. A later touch flattens the points of earlier touches at its place. The shape is the convex hull of all points,
    stretched sideways to the body's volume [m^3], which is known.
    """

    def __init__(self, volume: float, canonical: CanonicalGrid) -> None:
        self._volume, self._cells = volume, canonical_cells(canonical).points()
        self._touches: deque[FloatArray] = deque(maxlen=MAX_TOUCHES)  # (n, 3) each, body axes, from its middle [m]
        self._world_from_body = np.eye(3)
        self._before: FloatArray | None = None  # (2,) from the lower sensor to the upper, at the last touch [m]

    def add_observation(self, observation: Observation) -> None:
        """The next observation. Raises ValueError for a sensor without height."""
        max_points = 150  # kept of a touch
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
        felt = np.concatenate([below, above]) - middle
        self._touches.append(felt[:: len(felt) // max_points + 1] @ self._world_from_body)

    def points(self) -> FloatArray | None:
        """(n, 3) that fill the shape, world axes, from their mean [m]; None where not enough has been felt."""
        cell_count = 1500  # of the box round the shape
        from scipy.spatial import ConvexHull, QhullError

        if not self._touches:
            return None
        felt = np.concatenate(self._touches)
        try:
            hull = ConvexHull(felt)
        except QhullError:
            return None
        least, size = felt.min(axis=0), np.ptp(felt, axis=0)
        spacing = (size.prod() / cell_count) ** (1 / 3)
        axes = [np.arange(spacing / 2, length, spacing) for length in size]
        cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) + least
        inside = (cells @ hull.equations[:, :3].T + hull.equations[:, 3] <= 0.0).all(axis=1)
        if not inside.any():
            return None
        aside = (self._volume / hull.volume) ** 0.5
        shape = cells[inside] @ self._world_from_body.T * [aside, aside, 1.0]
        centred: FloatArray = shape - shape.mean(axis=0)
        return centred

    def _contact_points(self, touch: TactileObservation, arm: ArmState) -> FloatArray:
        """(n, 3) where the gel touches the body, world [m]."""
        if touch.height is None:
            raise ValueError("the shape of a body is felt by the gel's height, and this sensor delivers none")
        deepest = float(touch.height.max(where=touch.valid, initial=0.0))
        there = touch.contact & (touch.height > MIN_TOUCH_DEPTH * deepest)
        return se3.transform(arm.pose, np.column_stack([self._cells[there], -touch.height[there]]))

    def _rotate_body(self, displacement: FloatArray, below: FloatArray, above: FloatArray, height: float) -> None:
        """By the displacement (2,) of the upper gel over the lower [m]."""
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

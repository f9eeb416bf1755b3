"""Pose of a sensor on its arm, from touches of one fixed ball at many tilts of the sensor.

Unknown are tool_from_sensor and the ball's centre in the world: 9 numbers. Each touch gives the ball's centre in the
sensor's frame, and the pose of the tool transforms it to the world: three equations.

An error of the ball radius, or a common error of all depths, moves the result by the same length along the sensor's z,
and does not affect the residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.poses.robust_fit import BadMeasurements, RobustFit, angular_spread, perturb_pose, robust_fit
from calibration.poses.tuning import MAX_CAP_MISFIT, MIN_CONTACT_SPREAD, MIN_TOUCHES
from tacsim import pose as se3
from tacsim.interface import FloatArray, Mask, Pose, short_repr

MIN_SPREAD = np.radians(5.0)  # of the tilts, see angular_spread [rad]


@dataclass(frozen=True, slots=True)
class TouchNoise:
    """Standard deviations by which touches are weighted [m]."""

    centre: float = 0.03e-3  # of the contact's centre, in x and y
    depth: float = 0.05e-3
    robot: float = 0.05e-3  # of the tool's position, in each axis


@dataclass(frozen=True, slots=True, eq=False)
class BallTouch:
    tool: Pose  # world_from_tool; the world may be any fixed frame
    contact: tuple[float, float]  # centre of the contact, x, y in the sensor's frame [m]
    depth: float  # of the ball in the gel [m]


@dataclass(frozen=True, slots=True, eq=False)
class TouchFit:
    """Pose of the sensor and position of the ball, with their uncertainty."""

    __repr__ = short_repr
    tool_from_sensor: Pose
    ball: FloatArray  # (3,) its centre in the world [m]
    covariance: FloatArray  # (6, 6) of tool_from_sensor: shift [m] and rotation vector [rad], along the tool's axes
    bound: FloatArray  # (6, 6) Cramer-Rao bound of it
    residuals: FloatArray  # (n, 3) from `ball` to its position by each touch, along the sensor's axes [m]
    used: tuple[bool, ...]  # False: an outlier, left out
    scatter: float  # of the used touches over the stated noise

    @property
    def deviation(self) -> tuple[float, float]:
        """Standard deviations of position [m] and orientation [rad]."""
        return deviation(self.covariance)

    @property
    def best_deviation(self) -> tuple[float, float]:
        """The same by the Cramer-Rao bound, the minimum of all methods at the stated noise."""
        return deviation(self.bound)


def deviation(covariance: FloatArray) -> tuple[float, float]:
    """Standard deviations of position [m] and orientation [rad], each over all three axes, of a covariance (6, 6) of
    shift and rotation vector."""
    variance = np.diag(covariance)
    return float(np.sqrt(variance[:3].sum())), float(np.sqrt(variance[3:6].sum()))


def fit_touches(touches: Sequence[BallTouch], ball_radius: float, noise: TouchNoise | None = None) -> TouchFit:
    """Fits tool_from_sensor to touches of a ball of `ball_radius` [m].

    Maximum likelihood for independent normal noise; no first guess is needed. Raises BadMeasurements.
    """
    noise = TouchNoise() if noise is None else noise
    if len(touches) < MIN_TOUCHES:
        raise BadMeasurements(
            f"{len(touches)} touches are too few; at least {MIN_TOUCHES} are needed, 24 are recommended"
        )
    turn = np.stack([se3.rotation(touch.tool).as_matrix() for touch in touches])
    place = np.stack([touch.tool.position for touch in touches])
    contacts = np.array([(*touch.contact, ball_radius - touch.depth) for touch in touches])
    _check_spread(turn, contacts)
    sigma = np.sqrt(np.array([noise.centre, noise.centre, noise.depth]) ** 2 + noise.robot**2)

    def solve(base: FloatArray, starts: list[FloatArray]) -> RobustFit:
        def residuals(change: FloatArray) -> FloatArray:
            sensor = perturb_pose(base, change)
            in_tool = np.einsum("nji,nj->ni", turn, change[6:9] - place)
            residual: FloatArray = ((in_tool - sensor[:3, 3]) @ sensor[:3, :3] - contacts) / sigma
            return residual

        return robust_fit(residuals, starts, "touches")

    identity = np.eye(4)
    rough = solve(identity, _start_poses(turn, place, contacts))
    base, ball = perturb_pose(identity, rough.parameters[:6]), rough.parameters[6:9]
    fit = solve(base, [np.concatenate([np.zeros(6), ball])])  # again, where the rotation vector is small
    return TouchFit(
        tool_from_sensor=se3.from_matrix(perturb_pose(base, fit.parameters[:6])),
        ball=fit.parameters[6:9],
        covariance=fit.covariance[:6, :6],
        bound=fit.bound[:6, :6],
        residuals=fit.residuals * sigma,
        used=fit.used,
        scatter=fit.scatter,
    )


def _check_spread(turn: FloatArray, contacts: FloatArray) -> None:
    tilts = angular_spread(turn)
    if tilts < MIN_SPREAD:
        raise BadMeasurements(
            f"the tilts differ too little: one direction turns by only {np.degrees(tilts):.1f} degrees, "
            f"{np.degrees(MIN_SPREAD):.0f} are needed. Tilt the sensor about both axes of its gel, 20 degrees and more"
        )
    spread = float(np.sqrt(max(0.0, np.linalg.eigvalsh(np.cov(contacts[:, :2].T))[0])))
    if spread < MIN_CONTACT_SPREAD:
        raise BadMeasurements(
            f"the contacts lie too near to a point or a line on the gel: they spread by {1e3 * spread:.2f} mm in one "
            f"direction, {1e3 * MIN_CONTACT_SPREAD:g} mm are needed to identify the rotation of the sensor"
        )


def _start_poses(turn: FloatArray, place: FloatArray, contacts: FloatArray) -> list[FloatArray]:
    """Starts of the fit: the 24 rotations of a cube; for each, the rest is a linear problem."""
    count = len(turn)
    matrix = np.zeros((count, 3, 6))
    matrix[:, :, :3] = turn
    matrix[:, :, 3:] = -np.eye(3)
    starts = []
    for rotation in Rotation.create_group("O"):
        known = -(place + np.einsum("nij,nj->ni", turn, contacts @ rotation.as_matrix().T))
        shift_and_ball = np.linalg.lstsq(matrix.reshape(-1, 6), known.ravel(), rcond=None)[0]
        starts.append(np.concatenate([shift_and_ball[:3], rotation.as_rotvec(), shift_and_ball[3:]]))
    return starts


def locate_ball(height: FloatArray, valid: Mask, pitch: float, ball_radius: float) -> tuple[tuple[float, float], float]:
    """Contact centre (x, y) [m] and depth [m] of a ball, in a surface `height` (h, w) [m] on the canonical grid.

    Fits a ball of `ball_radius` to the cap deeper than half of the deepest point, where the gel touches the ball (by
    Hertz the contact circle is half as deep). Raises BadMeasurements if the surface shows no ball.
    """
    min_cells = 12  # of a cap
    cap_share = 0.5  # share of the largest depth beyond which the gel touches the ball (Hertz)
    from scipy.ndimage import label

    rows, columns = height.shape
    x = (np.arange(columns) - (columns - 1) / 2) * pitch
    y = (np.arange(rows) - (rows - 1) / 2) * pitch
    deepest = float(height[valid].max()) if valid.any() else 0.0
    if not deepest > 0.0:
        raise BadMeasurements("no contact in the gel")
    patches, _ = label((height > cap_share * deepest) & valid)
    cap = patches == patches[np.unravel_index(np.where(valid, height, -np.inf).argmax(), height.shape)]
    if cap.sum() < min_cells:
        raise BadMeasurements(f"the contact covers {int(cap.sum())} cells, {min_cells} are needed; press deeper")
    inner = valid.copy()
    inner[[0, -1], :] = inner[:, [0, -1]] = False
    if (cap & ~inner).any():
        raise BadMeasurements("the contact reaches the border of the surface; press nearer to the centre")
    grid_x, grid_y = np.meshgrid(x, y)
    px, py, pz = grid_x[cap], grid_y[cap], height[cap].astype(np.float64)
    # Gauss-Newton on z = depth - (R - sqrt(R^2 - r^2)), from the centre of the cap
    found = np.array([px.mean(), py.mean(), deepest])
    residual = np.zeros(0)
    for _ in range(10):
        dx, dy = px - found[0], py - found[1]
        root = np.sqrt(np.maximum(ball_radius**2 - dx**2 - dy**2, (0.1 * ball_radius) ** 2))
        residual = pz - (found[2] - ball_radius + root)
        jacobian = np.stack([dx / root, dy / root, np.ones_like(root)], axis=1)
        found = found + np.linalg.lstsq(jacobian, residual, rcond=None)[0]
    misfit = float(np.sqrt((residual**2).mean())) / deepest
    if not misfit < MAX_CAP_MISFIT:
        raise BadMeasurements(
            f"the contact is not that of a ball of {1e3 * ball_radius:.3g} mm: the misfit is {misfit:.0%} of the depth "
            f"({MAX_CAP_MISFIT:.0%} at most)"
        )
    return (float(found[0]), float(found[1])), float(found[2])

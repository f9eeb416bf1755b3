"""Robust least squares for rigid transforms, from measurements of which some are outliers.

Parameters are poses and points. Each measurement gives residuals divided by their standard deviations. A robust fit
(Cauchy's loss) finds the outliers; an ordinary fit without them follows, so its covariance is the standard one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calibration.errors import CalibrationError
from calibration.poses.tuning import MAX_OUTLIERS, MAX_SCATTER, OUTLIER_DISTANCE
from tacsim.interface import FloatArray, Mask

Residuals = Callable[[FloatArray], FloatArray]


class BadMeasurements(CalibrationError):
    """The measurements determine no transform: they are too few, too similar, or contradictory."""


@dataclass(frozen=True, slots=True, eq=False)
class RobustFit:
    """A fit and its uncertainty."""

    parameters: FloatArray  # (p,) added to the start: for a pose, shift [m] and rotation vector [rad]
    covariance: FloatArray  # (p, p) of it, for the stated noise, or the observed one if that is larger
    bound: FloatArray  # (p, p) Cramer-Rao bound of the covariance at the stated noise
    residuals: FloatArray  # (n, k) over their standard deviations, of all measurements
    used: tuple[bool, ...]  # (n,) False: an outlier, left out
    scatter: float  # root mean square of the used residuals, by degrees of freedom: 1 if the stated noise is right


def robust_fit(residuals: Residuals, starts: Sequence[FloatArray], what: str) -> RobustFit:
    """Fits parameters (p,) so that `residuals` (n, k), each over its standard deviation, become small.

    starts: the best of the fits from each is taken. what: the measurements in a word, for messages.
    Raises BadMeasurements.
    """

    max_rounds = 4  # of removing outliers and fitting again
    max_starts = 4  # the most promising starts are fitted

    def flat(parameters: FloatArray) -> FloatArray:
        return residuals(parameters).ravel()

    # Cauchy's loss has little effect far from the solution; the soft L1 loss leads near it.
    promising = sorted(starts, key=lambda start: float(np.abs(flat(start)).sum()))[:max_starts]
    rough = [least_squares(flat, start, loss="soft_l1", x_scale="jac", ftol=1e-3, max_nfev=30) for start in promising]
    best = min(rough, key=lambda fit: float(fit.cost))
    found = least_squares(flat, best.x, loss="cauchy", x_scale="jac", max_nfev=60).x
    used = np.ones(len(residuals(found)), dtype=np.bool_)
    for _ in range(max_rounds):
        apart = np.sqrt((residuals(found) ** 2).sum(axis=1))
        # noise may be larger than stated, so outliers must also be far from the others
        usual = max(1.0, float(np.median(apart)) / np.sqrt(residuals(found).shape[1]))
        keep = apart < OUTLIER_DISTANCE * usual
        if keep.sum() < max(1, (1 - MAX_OUTLIERS) * len(keep)):
            raise BadMeasurements(
                f"{int((~keep).sum())} of {len(keep)} {what} disagree with the others: is the fixed part "
                "really fixed, do the poses belong to the pictures, and are lengths in metres?"
            )
        fit, before = _minimise_residuals(residuals, found, keep), used
        found, used = fit.x, keep
        if (used == before).all():
            break
    everything = residuals(found)
    jacobian = np.asarray(fit.jac, dtype=np.float64)
    information: FloatArray = jacobian.T @ jacobian
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))  # so that the rank does not depend on units
    if np.linalg.matrix_rank(information / np.outer(scale, scale), tol=1e-10) < len(found):
        raise BadMeasurements(f"{what} do not determine all of the transform: vary places and tilts more")
    bound: FloatArray = np.asarray(np.linalg.inv(information), dtype=np.float64)
    free = everything[used].size - len(found)
    scatter = float(np.sqrt((everything[used] ** 2).sum() / free)) if free > 0 else 0.0
    if scatter > MAX_SCATTER:
        raise BadMeasurements(
            f"{what} disagree: they scatter {scatter:.1f} times as much as the stated noise allows ({MAX_SCATTER:g} at "
            "most); is something loose, a length or a frame wrong, or the noise larger than stated?"
        )
    return RobustFit(
        parameters=found,
        covariance=bound * max(1.0, scatter) ** 2,
        bound=bound,
        residuals=everything,
        used=tuple(bool(each) for each in used),
        scatter=scatter,
    )


def _minimise_residuals(residuals: Residuals, start: FloatArray, keep: Mask) -> Any:
    def flat(parameters: FloatArray) -> FloatArray:
        return residuals(parameters)[keep].ravel()

    return least_squares(flat, start, method="lm", x_scale="jac")


def angular_spread(rotations: FloatArray) -> float:
    """How much `rotations` (n, 3, 3) differ [rad]: root mean square angle by which they turn the direction that they
    turn least; 0 if all turn about one axis.

    With R the rotations and M their mean, it is the least singular value of the standard deviation of R over all
    directions: the least eigenvalue of I - M^T M is its square.
    """
    mean = rotations.mean(axis=0)
    least = float(np.linalg.eigvalsh(np.eye(3) - mean.T @ mean)[0])
    return float(np.arcsin(np.sqrt(np.clip(least, 0.0, 1.0))))


def perturb_pose(pose: FloatArray, change: FloatArray) -> FloatArray:
    """`pose` (4, 4), shifted by change[:3] [m] and turned about its own origin by the rotation vector change[3:]; both
    along the axes of the frame that the pose is given in."""
    result = pose.copy()
    result[:3, :3] = Rotation.from_rotvec(change[3:6]).as_matrix() @ pose[:3, :3]
    result[:3, 3] += change[:3]
    return result

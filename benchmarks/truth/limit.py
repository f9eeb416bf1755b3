"""The limit of the ball's press for vanishing element size: the reference for every method that presses a ball.

It takes many minutes to compute, so the profile is shipped with the package; `tacsim bench press --renew` computes it
again. It depends on the problem, not on a version of the code.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim.models.scene import GelSurface
from tacsim.optics.spline import displacement_and_jacobian

Float64 = NDArray[np.float64]

RADIUS = 4e-3  # of the ball [m]
DEPTH = 1e-3  # of the ball's tip below the undeformed surface [m]
LIMIT = "limit of h = 0.25 and 0.125 mm"
FOLDER = Path(__file__).parents[1] / "references"
GRID_PITCH = 0.25e-3  # of the common grid on which surfaces are compared [m]
GRID_HALF = 10e-3  # half the side of the grid, which covers the gel [m]
ELEMENTS = (0.5e-3, 0.25e-3, 0.125e-3)


@dataclass(frozen=True, slots=True, eq=False)
class Limit:
    """The extrapolated surface, and data on its computation."""

    profile: Float64  # (81, 81) u_z of the top surface at material points x (first index), y [m]
    config: dict[str, Any]


def surface_profile(surface: GelSurface) -> Float64:
    """u_z [m] of the B-spline surface on the common grid of material points, (81, 81)."""
    line = np.linspace(-GRID_HALF, GRID_HALF, round(2 * GRID_HALF / GRID_PITCH) + 1)
    points = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    displacement, _ = displacement_and_jacobian(surface, points)
    return displacement[:, 2].reshape(len(line), len(line))


def rms(difference: Float64) -> float:
    return float(np.sqrt(np.mean(difference**2)))


def load_limit() -> Limit:
    """The shipped limit. Raises FileNotFoundError if the package lacks it."""
    profile = np.load(FOLDER / "sphere_press.npy", allow_pickle=False).astype(np.float64)
    config = json.loads((FOLDER / "sphere_press.json").read_text(encoding="utf-8"))
    return Limit(profile, config)


def extrapolate(coarse: Float64, middle: Float64, fine: Float64) -> tuple[Float64, float]:
    """Richardson's limit of three profiles, each at half the element size of the one before; and the observed order.

    The order p comes from the norms of the two differences, error ~ h^p; the limit from the two finer profiles.
    Raises ValueError if the profiles do not converge.
    """
    ratio = rms(coarse - middle) / rms(middle - fine)
    if not ratio > 1.2:
        raise ValueError(
            f"the differences of the three meshes decrease by a factor of {ratio:.2f} only: nothing to extrapolate"
        )
    order = float(np.log2(ratio))
    return fine + (fine - middle) / (ratio - 1.0), order

"""Centre and second moments of a body's particles, for the parameters of a launch."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tacsim.physics.body.plasticine import BodyState, centre_of


@dataclass(frozen=True)
class Moments:
    """Sums over the particles of one body, in float64; an arm is a position minus the mean position."""

    centre: np.ndarray  # (3,) of the particles [mm]
    reference_centre: np.ndarray  # (3,) of their reference positions on the grid [mm]
    second: np.ndarray  # (3, 3) arm arm^T of the particles [mm^2]
    reference_second: np.ndarray  # (3, 3) the same of their reference positions [mm^2]
    cross_moments: np.ndarray  # (3, 3) sum of (arm - reference arm) reference arm^T [mm^2]

    def mean_displacement_gradient(self) -> np.ndarray:
        """Mean displacement gradient of the particles since the reference (3, 3)."""
        gradient: np.ndarray = self.cross_moments @ _inverse_of(self.reference_second.tobytes())
        return gradient

    def inverse_inertia(self, mass: float) -> np.ndarray:
        """Pseudo-inverse of the moment of inertia (3, 3); `mass` of a particle. Particles on one line have no moment of
        inertia about it and get no rotation about it."""
        second = self.second * mass
        moments, axes = np.linalg.eigh(second.trace() * np.eye(3) - second)
        moments, axes = moments[::-1], np.ascontiguousarray(axes[:, ::-1])
        inverse = np.divide(1.0, moments, out=np.zeros(3), where=moments > 1e-6 * moments[0])
        turns: np.ndarray = axes @ (inverse[:, None] * axes.T)
        return turns


@lru_cache(maxsize=256)
def _inverse_of(second: bytes) -> np.ndarray:
    """Pseudo-inverse of second moments (3, 3) float64. Cached, since a reference stays for many launches."""
    inverse: np.ndarray = np.linalg.pinv(np.frombuffer(second).reshape(3, 3), rcond=1e-6, hermitian=True)
    return inverse


def moments_of(particles: BodyState, environment: int) -> Moments:
    x, reference = particles.x(environment), particles.grid_layout(environment)
    centre = centre_of(x)
    here = (x - centre).T
    cross = (here - reference.arms) @ reference.arms.T
    return Moments(centre, reference.centre, here @ here.T, reference.second, cross)

"""Where the particles of a body are, in a few numbers: what a launch needs of them."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tacsim.physics.body.plasticine import BodyState, centre_of


@dataclass(frozen=True)
class Moments:
    """Sums over the particles of one body, in float64; an arm is a place less the mean of all."""

    centre: np.ndarray  # (3,) of the particles [mm]
    reference_centre: np.ndarray  # (3,) of their places on the grid [mm]
    second: np.ndarray  # (3, 3) arm arm^T of the particles [mm^2]
    reference_second: np.ndarray  # (3, 3) the same of their places on the grid [mm^2]
    moved: np.ndarray  # (3, 3) by how much the arm has changed since the reference, times the arm there^T [mm^2]

    def carried(self) -> np.ndarray:
        """Mean displacement gradient of the particles since the reference (3, 3)."""
        gradient: np.ndarray = self.moved @ _inverse_of(self.reference_second.tobytes())
        return gradient

    def inverse_inertia(self, mass: float) -> np.ndarray:
        """Pseudo-inverse of the moment of inertia (3, 3), `mass` of a particle. Particles on a line have none about it,
        and do not turn about it."""
        second = self.second * mass
        moments, axes = np.linalg.eigh(second.trace() * np.eye(3) - second)
        moments, axes = moments[::-1], np.ascontiguousarray(axes[:, ::-1])
        inverse = np.divide(1.0, moments, out=np.zeros(3), where=moments > 1e-6 * moments[0])
        turns: np.ndarray = axes @ (inverse[:, None] * axes.T)
        return turns


@lru_cache(maxsize=256)
def _inverse_of(second: bytes) -> np.ndarray:
    """Pseudo-inverse of second moments (3, 3) float64: those of a reference stay for many launches."""
    inverse: np.ndarray = np.linalg.pinv(np.frombuffer(second).reshape(3, 3), rcond=1e-6, hermitian=True)
    return inverse


def moments_of(particles: BodyState, environment: int) -> Moments:
    x, laid = particles.x(environment), particles.laid(environment)
    centre = centre_of(x)
    here = (x - centre).T
    return Moments(centre, laid.centre, here @ here.T, laid.second, (here - laid.arms) @ laid.arms.T)

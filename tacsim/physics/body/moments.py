"""Where the particles of a body are, in a few numbers: what a launch needs of them."""

from dataclasses import dataclass

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


def moments_of(particles: BodyState, environment: int) -> Moments:
    x, reference = particles.x(environment), particles.reference(environment)
    centre, reference_centre = centre_of(x), centre_of(reference)
    there = (reference - reference_centre).T
    here = (x - centre).T
    return Moments(centre, reference_centre, here @ here.T, there @ there.T, (here - there) @ there.T)

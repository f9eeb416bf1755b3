"""What counts as rest."""

from dataclasses import replace

import numpy as np
import pytest

from tacsim.interface import Pose
from tacsim.models.scene import Settling
from tacsim.physics.motion.controller import ForceReading, move_and_settle, residual, run, still_to_come
from tacsim.physics.motion.path import Path


def test_contact_forces_balance_the_weight_of_the_body() -> None:
    weight = np.array([0.0, 0.3, -0.4])
    contact = np.array([[0.0, 0.3, -1.4], [0.0, 0.0, 1.0]])  # on the gels
    hung = ForceReading(contact, contact, 0.1, 0.0, 0, load=weight)
    assert residual(hung, hung, balanced=True) == pytest.approx(0.0, abs=1e-12)
    weightless = replace(hung, load=None)
    assert residual(weightless, weightless, balanced=True) == pytest.approx(0.4 / 1.4)
    falling = replace(hung, contact=np.zeros((2, 3)), backing=np.zeros((2, 3)))
    assert residual(falling, falling, balanced=True) == pytest.approx(0.4 / 0.1)
    assert residual(falling, falling, balanced=False) == 0.0


def reading(drag: float) -> ForceReading:
    force = np.array([[drag, 0.0, -1.0]])
    return ForceReading(force, force, 0.1, 0.0, 0)


def test_what_creeps_is_held_until_little_is_left_of_it() -> None:
    """A drag that loses 5 % of what it is above 0.5 from reading to reading: each change is soon within the tolerance,
    while 20 times as much is still to come."""
    drags = (0.5 + 0.1 * 0.95**n for n in range(1000))
    path = Path([Pose()], [Pose()], 0, 0.4)
    stats = run(
        move_and_settle(path, Settling(max_substeps=100_000), balanced=False),
        lambda path, first, last: reading(next(drags)),
    )
    left = 0.1 * 0.95 ** (stats.hold // path.interval - 1)
    assert stats.settled
    assert 0.5e-2 < left <= 1e-2
    assert stats.residual == pytest.approx(left, rel=0.01)


def test_what_swings_or_stands_has_nothing_still_to_come() -> None:
    assert still_to_come(reading(0.5), reading(0.51), reading(0.505)) == 0.0
    assert still_to_come(reading(0.5), reading(0.5), reading(0.5)) == 0.0

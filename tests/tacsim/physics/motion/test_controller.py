"""What counts as rest."""

from dataclasses import replace

import numpy as np
import pytest

from tacsim.physics.motion.controller import ForceReading, residual


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

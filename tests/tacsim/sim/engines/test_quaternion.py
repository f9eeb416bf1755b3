"""Quaternions as plain numbers against SciPy's rotations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tacsim.sim.engines.quaternion import product, rotated, rotation_vector, turned_by

RANDOM = np.random.default_rng(5)
PAIRS = [(Rotation.random(random_state=n), Rotation.random(random_state=99 + n)) for n in range(20)]


@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_they_are_scipys(first: Rotation, second: Rotation) -> None:
    vector, small = RANDOM.normal(size=3), 1e-7 * RANDOM.normal(size=3)
    together = Rotation.from_quat(product(first.as_quat(), second.as_quat()))
    assert together.as_matrix() == pytest.approx((first * second).as_matrix(), abs=1e-14)
    assert rotated(vector, first.as_quat()) == pytest.approx(first.apply(vector), abs=1e-14)
    for way in (vector, small, np.zeros(3)):
        turned = Rotation.from_quat(turned_by(first.as_quat(), way))
        assert turned.as_matrix() == pytest.approx((Rotation.from_rotvec(way) * first).as_matrix(), abs=1e-14)
    for sign in (1.0, -1.0):
        assert rotation_vector(sign * first.as_quat()) == pytest.approx(first.as_rotvec(), abs=1e-14)
    assert rotation_vector(Rotation.from_rotvec(small).as_quat()) == pytest.approx(small, rel=1e-12)
    assert rotation_vector((0.0, 0.0, 0.0, 1.0)) == (0.0, 0.0, 0.0)

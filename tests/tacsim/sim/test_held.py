"""Pictures of pads that hold an object."""

from __future__ import annotations

import numpy as np
import pytest

from tacsim import HeldObject, HeldObjects, facing_pads, load_sensor
from tacsim.models.scene import Sphere


def test_a_pad_sees_the_object_that_it_holds() -> None:
    pads = facing_pads([[0, 0, 0, 0, 0, 0, 1.0]], [20.4e-3])
    ball = HeldObject(Sphere(radius=10e-3), 0.05)
    held = HeldObjects([ball], sensor=load_sensor("gelsight-mini"))
    held.reset([[0, 0, 0, 0, 0, 0, 1.0]], pads)
    before = held.picture(0, 0).astype(float)
    held.grasp(pads, [4.0])
    after = held.picture(0, 0).astype(float)
    middle, corner = np.abs(after - before)[100:140, 140:180].mean(), np.abs(after - before)[:10, :10].mean()
    assert middle > 5 * max(corner, 0.2)
    assert held.surface(0, 1).displacement[..., 2].min() < -0.5e-3
    with pytest.raises(ValueError, match="have no camera"):
        HeldObjects([ball]).picture(0, 0)

"""Descriptions of held objects, supports and grippers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tacsim.models.scene import Mesh
from tacsim.physics.grip.model import HeldObject, Support, centre_of_mass, facing_pads
from tests.tacsim.physics.grip.gripping import BOX


@pytest.mark.parametrize("mass", [0.0, -1.0, float("nan"), float("inf"), 1e9])
def test_a_mass_that_is_none_is_refused(mass: float) -> None:
    with pytest.raises(ValueError, match=r"mass is .* kg; give one above 0"):
        HeldObject(BOX, mass)


def test_a_centre_of_mass_is_given_or_that_of_an_even_density(tmp_path: object) -> None:
    import trimesh

    path = f"{tmp_path}/cone.stl"
    trimesh.creation.cone(radius=5e-3, height=20e-3).export(path)
    cone = centre_of_mass(HeldObject(Mesh(path=path, scale=1.0), 0.1))
    assert cone == pytest.approx([0.0, 0.0, -5e-3], abs=0.1e-3)  # a quarter of its height above its base
    assert not centre_of_mass(HeldObject(BOX, 0.1)).any()
    assert list(centre_of_mass(HeldObject(BOX, 0.1, centre_of_mass=(0.0, 1e-3, 0.0)))) == [0.0, 1e-3, 0.0]
    with pytest.raises(ValueError, match="centre_of_mass"):
        HeldObject(BOX, 0.1, centre_of_mass=(0.0, float("nan"), 0.0))


def test_facing_pads_look_at_each_other_with_the_width_between_them() -> None:
    pose = np.array([0.1, 0.2, 0.3, *Rotation.from_euler("z", 90, degrees=True).as_quat()])
    pads = facing_pads(np.tile(pose, (2, 1)), [10e-3, 20e-3])
    assert pads.shape == (2, 2, 7)
    outward = Rotation.from_quat(pads[1, :, 3:]).apply([0.0, 0.0, 1.0])
    assert outward == pytest.approx(np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]), abs=1e-12)
    assert pads[1, :, :3] == pytest.approx(np.array([[0.1, 0.19, 0.3], [0.1, 0.21, 0.3]]))
    assert np.linalg.norm(pads[0, 0, :3] - pads[0, 1, :3]) == pytest.approx(10e-3)


def test_a_support_has_numbers_of_all_grips_or_of_each() -> None:
    rows = Support([1.0] * 6, max_force=[1.0, 2.0]).rows(2)
    assert rows[:, :6].tolist() == [[1.0] * 6] * 2
    assert rows[:, 6:8].tolist() == [[1.0, float("inf")], [2.0, float("inf")]]

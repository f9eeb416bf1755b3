import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tacsim.models.scene import Gel
from tacsim.physics.contact.gel_overlap import gel_overlap
from tacsim.physics.gel.gel import gel_params


def test_overlap_of_gels_is_that_of_their_deformed_surfaces() -> None:
    params = gel_params(Gel(size=(10e-3, 8e-3, 4e-3)), 1e-3)
    tops = np.zeros((2, 11, 9, 3), np.float32)
    turned = Rotation.from_euler("zx", [30, 180], degrees=True).as_matrix()
    rotations = np.stack([np.eye(3), turned])

    def found(x: float, z: float) -> float:
        return gel_overlap(params, tops, rotations, np.array([[1.0, 2.0, 3.0], [1.0 + x, 2.0, 3.0 + z]]))

    assert found(0.0, 0.01) == 0.0 and found(0.0, -0.3) == pytest.approx(0.3)
    assert found(20.0, -0.3) == 0.0  # beside one another
    tops[0, ..., 2] = -0.2
    assert found(0.0, -0.3) == pytest.approx(0.1)
    tops[1, 3, 4, 2] = 0.25  # a bump
    assert found(0.0, -0.1) == pytest.approx(0.15)

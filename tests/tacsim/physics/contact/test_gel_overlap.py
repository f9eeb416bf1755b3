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
        return gel_overlap((params, params), tops, rotations, np.array([[1.0, 2.0, 3.0], [1.0 + x, 2.0, 3.0 + z]]))

    assert found(0.0, 0.01) == 0.0 and found(0.0, -0.3) == pytest.approx(0.3)
    assert found(20.0, -0.3) == 0.0  # beside one another
    tops[0, ..., 2] = -0.2
    assert found(0.0, -0.3) == pytest.approx(0.1)
    tops[1, 3, 4, 2] = 0.25  # a bump
    assert found(0.0, -0.1) == pytest.approx(0.15)


def test_gels_of_two_sizes_overlap_where_both_are() -> None:
    wide, narrow = gel_params(Gel(size=(10e-3, 8e-3, 4e-3)), 1e-3), gel_params(Gel(size=(4e-3, 3e-3, 2e-3)), 0.5e-3)
    tops = [np.zeros((11, 9, 3), np.float32), np.zeros((9, 7, 3), np.float32)]
    tops[0][:2, :, 2], tops[1][0, 0, 2] = 3.0, 0.25  # a bump beside the narrow gel, and one at its corner
    rotations = np.stack([np.eye(3), Rotation.from_euler("x", 180, degrees=True).as_matrix()])
    for turn in (1, -1):
        gels, order = (wide, narrow)[::turn], slice(None, None, turn)
        found = gel_overlap(gels, tops[::turn], rotations[order], np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.1]])[order])
        assert found == pytest.approx(0.15)

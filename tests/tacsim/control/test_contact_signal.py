import numpy as np
import pytest

from tacsim.control.contact_signal import contact_signal, pixel_mask
from tacsim.interface import TactileObservation


def _observation(image: np.ndarray, valid: np.ndarray) -> TactileObservation:
    return TactileObservation(
        image=image, gradient=None, height=None, contact=np.zeros_like(valid), valid=valid, flow=None, time=0.0, age=0.0
    )


def test_signal_is_the_mean_relative_change_over_valid_pixels() -> None:
    image = np.full((8, 12, 3), 128, dtype=np.uint8)
    valid = np.ones((4, 6), dtype=bool)
    assert contact_signal(_observation(image, valid)) == 0.0
    image[:2, :, 0] = 128 + 64  # a quarter of the rows, one channel of three, half of mean(I0)
    assert contact_signal(_observation(image, valid)) == pytest.approx(0.5 / 4 / 3)
    image[:2, :, 0] = 128 - 64  # darker counts as much
    assert contact_signal(_observation(image, valid)) == pytest.approx(0.5 / 4 / 3)
    valid[0] = False  # the changed rows are no gel
    assert contact_signal(_observation(image, valid)) == 0.0


def test_no_valid_pixel_is_an_error() -> None:
    with pytest.raises(ValueError, match="no valid pixel"):
        contact_signal(_observation(np.zeros((8, 8, 3), dtype=np.uint8), np.zeros((4, 4), dtype=bool)))


def test_mask_needs_whole_cells() -> None:
    cells = np.array([[True, False], [False, False]])
    np.testing.assert_array_equal(pixel_mask(cells, (4, 4))[:2, :2], True)
    assert pixel_mask(cells, (4, 4)).sum() == 4
    with pytest.raises(ValueError, match="no whole multiple"):
        pixel_mask(cells, (4, 5))

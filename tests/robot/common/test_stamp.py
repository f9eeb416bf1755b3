from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from robot.common import stamp

MARK = stamp.Stamp(frame=0xDEADBEEF, image=17, clock=123_456_789_012_345)


def through_jpeg(image: np.ndarray, quality: int, subsampling: int) -> np.ndarray:
    data = io.BytesIO()
    Image.fromarray(image).save(data, "JPEG", quality=quality, subsampling=subsampling)
    return np.array(Image.open(data).convert("RGB"))


@pytest.mark.parametrize("subsampling", [0, 1, 2])
@pytest.mark.parametrize("quality", [50, 75, 90, 100])
@pytest.mark.parametrize("shape", [(240, 320), (480, 640), (37, 101), (16, 16)])
def test_stamp_below_any_image_survives_jpeg(shape: tuple[int, int], quality: int, subsampling: int) -> None:
    image = np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)
    image[:, :, 0] = 255
    stamped = stamp.draw(image, MARK)
    assert stamped.shape == (shape[0] + stamp.strip_rows(shape[1]), shape[1], 3)
    assert stamp.read(through_jpeg(stamped, quality, subsampling)) == MARK


def test_stamp_keeps_image_unchanged() -> None:
    image = np.random.default_rng(1).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    picture, mark = stamp.split(stamp.draw(image, MARK))
    assert np.array_equal(picture, image) and mark == MARK
    assert stamp.strip_rows(320) == 16


def test_stamp_with_damaged_bit_is_rejected() -> None:
    stamped = stamp.draw(np.zeros((16, 320, 3), dtype=np.uint8), MARK)
    for bit in range(stamp.BITS):
        row, column = divmod(bit, 80)
        broken = stamped.copy()
        block = broken[16 + 8 * row : 24 + 8 * row, 4 * column : 4 * column + 4]
        block[...] = 255 - block
        assert stamp.read(broken) is None


@pytest.mark.parametrize("value", [0, 127, 128, 255])
def test_image_without_stamp_returns_none(value: int) -> None:
    assert stamp.read(np.full((64, 320, 3), value, dtype=np.uint8)) is None


def test_stamp_too_small_image_raises_or_returns_none() -> None:
    assert stamp.read(np.zeros((8, 320, 3), dtype=np.uint8)) is None
    assert stamp.read(np.zeros((8, 2, 3), dtype=np.uint8)) is None
    with pytest.raises(ValueError, match="at least 4 px wide"):
        stamp.strip_rows(3)


def test_stamp_too_large_number_raises_value_error() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        stamp.draw(np.zeros((16, 320, 3), dtype=np.uint8), stamp.Stamp(frame=2**32, image=0, clock=0))

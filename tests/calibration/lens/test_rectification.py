import cv2
import numpy as np
import pytest

from calibration.lens.rectification import rectification_of_corners, rectification_of_geometry
from calibration.lens.view import BadCorners
from tacsim.models.sensor import CanonicalGrid, SensorGeometry
from tacsim.optics.grid import canonical_image

GRID = canonical_image(CanonicalGrid())  # 128 x 128 px of 0.125 mm
SIZE = (16e-3, 16e-3)
CORNERS = ((67.0, 68.0), (465.0, 113.0), (475.0, 383.0), (73.0, 437.0))


def _colour(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth picture on the gel without any symmetry, 0..255; x, y in mm."""
    red = 120 + 8 * x + 3 * y
    green = 100 + 60 * np.exp(-((x - 3) ** 2 + (y - 2) ** 2) / 8)
    blue = 90 - 5 * y + 0.5 * x * y
    return np.stack([red, green, blue], axis=-1)


def _photograph(corners: tuple[tuple[float, float], ...], shape: tuple[int, int]) -> np.ndarray:
    """What a camera sees: for each of its pixels, the colour at the gel point on its line of sight."""
    gel = np.array([(-8, -8), (8, -8), (8, 8), (-8, 8)], dtype=np.float32)
    gel_from_image = cv2.getPerspectiveTransform(np.array(corners, dtype=np.float32), gel)
    u, v = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    w = np.stack([u, v, np.ones_like(u)], axis=-1) @ gel_from_image.T
    return np.clip(np.rint(_colour(w[..., 0] / w[..., 2], w[..., 1] / w[..., 2])), 0, 255).astype(np.uint8)


def test_perspective_is_undone() -> None:
    rectify = rectification_of_corners(CORNERS, SIZE, (480, 640), GRID)
    points = GRID.points() * 1e3
    expected = _colour(points[..., 0], points[..., 1])
    found = rectify(_photograph(CORNERS, (480, 640)))
    assert rectify.valid.all()
    assert rectify.factor == 4  # 3.1 native pixels along a canonical one
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, atol=1.0)
    assert np.abs(found - expected[:, ::-1]).max() > 50  # a mirrored map would show
    assert np.abs(found - expected.transpose(1, 0, 2)).max() > 20


def test_averaging_calms_the_cameras_noise() -> None:
    noise = np.random.default_rng(0).normal(100.0, 6.0, (480, 640, 3))
    calm = rectification_of_corners(CORNERS, SIZE, (480, 640), GRID)(np.rint(noise).astype(np.uint8))
    assert calm.std() < 6.0 / 2.4  # 2.3 x 3.1 native pixels in each; bilinear look-up alone would keep 6 / 1.5


def test_whole_image_with_equal_pixels_is_the_identity() -> None:
    image = np.random.default_rng(1).integers(0, 256, (128, 128, 3)).astype(np.uint8)
    rectify = rectification_of_corners(None, SIZE, (128, 128), GRID)
    assert rectify.valid.all()
    np.testing.assert_array_equal(rectify(image), image)


def test_simulated_image_is_averaged_over_whole_blocks() -> None:
    geometry = SensorGeometry()  # 320 x 240 px of 0.0625 mm: 2 x 2 of them a canonical pixel
    image = np.random.default_rng(2).integers(0, 256, (240, 320, 3)).astype(np.uint8)
    rectify = rectification_of_geometry(geometry, (20e-3, 20e-3), GRID)
    found = rectify(image)
    blocks = image.reshape(120, 2, 160, 2, 3).astype(np.float64).mean(axis=(1, 3))
    np.testing.assert_allclose(found[4:124], blocks[:, 16:144], atol=1e-4)
    assert rectify.valid[4:124].all()
    assert not rectify.valid[:4].any()  # the image is 15 mm high, the canonical grid 16 mm
    assert not rectify.valid[124:].any()
    assert not found[:4].any()


def test_off_axis_geometry_shifts_the_picture() -> None:
    image = np.zeros((240, 320, 3), dtype=np.uint8)
    image[30:32, 100:102] = 255
    geometry = SensorGeometry(centre=(100.5 - 2 * 10.5, 30.5 + 2 * 5.5))  # the spot is 10.5 canonical px right, 5.5 up
    found = rectification_of_geometry(geometry, (20e-3, 20e-3), GRID)(image)
    assert np.argwhere(found[..., 0] > 200).tolist() == [[64 - 6, 64 + 10]]


def test_pixels_off_the_gel_are_invalid() -> None:
    rectify = rectification_of_geometry(SensorGeometry(), (8e-3, 4e-3), GRID)
    assert rectify.valid.sum() == 64 * 32
    assert rectify.valid[64 - 16 : 64 + 16, 64 - 32 : 64 + 32].all()
    small = rectification_of_corners(CORNERS, (8e-3, 4e-3), (480, 640), GRID)
    np.testing.assert_array_equal(small.valid, rectify.valid)


def test_gel_partly_outside_the_image_is_invalid_there() -> None:
    rectify = rectification_of_corners(
        ((-100.0, 10.0), (300.0, 10.0), (300.0, 230.0), (-100.0, 230.0)), SIZE, (240, 320), GRID
    )
    assert not rectify.valid[:, :31].any()
    assert rectify.valid[:, 33:].all()


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        ((CORNERS[1], CORNERS[0], CORNERS[3], CORNERS[2]), "no convex quadrangle"),  # mirrored
        ((CORNERS[0], CORNERS[2], CORNERS[1], CORNERS[3]), "no convex quadrangle"),  # crossed
        (((0.0, 0.0), (100.0, 0.0), (200.0, 0.0), (0.0, 100.0)), "no convex quadrangle"),
        (((0.0, 0.0), (9000.0, 0.0), (9000.0, 9000.0), (0.0, 9000.0)), "far outside the image of 640 x 480 px"),
        (((np.nan, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)), "4 finite pixels"),
    ],
)
def test_bad_corners_are_refused(corners: tuple[tuple[float, float], ...], message: str) -> None:
    with pytest.raises(BadCorners, match=message):
        rectification_of_corners(corners, SIZE, (480, 640), GRID)  # type: ignore[arg-type]


def test_another_image_is_refused() -> None:
    rectify = rectification_of_corners(CORNERS, SIZE, (480, 640), GRID)
    with pytest.raises(ValueError, match=r"image is \(240, 320, 3\) uint8, this sensor delivers \(480, 640, 3\)"):
        rectify(np.zeros((240, 320, 3), dtype=np.uint8))
    with pytest.raises(ValueError, match="float64"):
        rectify(np.zeros((480, 640, 3)))  # type: ignore[arg-type]


def test_a_pitch_in_millimetres_by_mistake_is_refused() -> None:
    with pytest.raises(ValueError, match="at most 16 are averaged"):
        rectification_of_corners(CORNERS, (16e-6, 16e-6), (480, 640), GRID)

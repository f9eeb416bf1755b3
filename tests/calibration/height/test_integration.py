"""Slopes to height, and slopes improved by the forward model of the light."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from calibration.height.surface_finder import ForwardSteps, Integrator, slopes_of
from tacsim.models.photometric import (
    DEPTH_TERMS,
    SHADOW_SLOPES,
    CastShadows,
    DepthColour,
    PhotometricLight,
    PhotometricModel,
    horizon_slope,
    image_grid_places,
)

PITCH = 0.1e-3


def _bump(shape: tuple[int, int], centre: tuple[float, float], width: float) -> tuple[np.ndarray, np.ndarray]:
    """Height (rows, columns) [m] of a Gaussian 1 mm high, and its slopes; centre and width [px]."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    dx, dy = x - centre[0], y - centre[1]
    height = 1e-3 * np.exp(-(dx**2 + dy**2) / (2 * width**2))
    gradient = -np.stack([dx, dy], axis=-1) * (height / (width**2 * PITCH))[..., None]
    return height, gradient.astype(np.float32)


@pytest.mark.parametrize("shape", [(120, 160), (97, 64)])
def test_a_bump_comes_back_from_its_slopes_in_metres(shape: tuple[int, int]) -> None:
    height, gradient = _bump(shape, (shape[1] / 2 + 3, shape[0] / 2 - 2), 10.0)
    found = Integrator(shape, PITCH)(gradient)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, height, atol=3e-6)


def test_zero_is_the_untouched_border_even_where_a_contact_crosses_it() -> None:
    """A bump at the border of the view: its own height there must not become zero, nor sink the rest."""
    height, gradient = _bump((120, 160), (0.0, 60.0), 10.0)
    found = Integrator((120, 160), PITCH)(gradient)
    assert found[60, 0] == pytest.approx(1e-3, rel=0.02)
    np.testing.assert_allclose(found, height, atol=10e-6)


def test_a_bulge_is_no_zero() -> None:
    """Beside a dent the gel bulges out, below zero: the least height is no reference."""
    dent, slopes = _bump((120, 160), (60.0, 60.0), 10.0)
    bulge, bulge_slopes = _bump((120, 160), (110.0, 60.0), 8.0)
    found = Integrator((120, 160), PITCH)(slopes - 0.2 * bulge_slopes)
    np.testing.assert_allclose(found, dent - 0.2 * bulge, atol=3e-6)


def test_noise_of_slopes_hardly_moves_the_height() -> None:
    noise = np.random.default_rng(0).normal(0.0, 0.02, size=(120, 160, 2)).astype(np.float32)
    assert np.abs(Integrator((120, 160), PITCH)(noise)).max() < 15e-6


def test_no_rectangle_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 2 x 2"):
        Integrator((1, 50), PITCH)


ROWS, COLUMNS = 120, 160
U, V = image_grid_places(COLUMNS, ROWS)
Y, X = np.mgrid[:ROWS, :COLUMNS].astype(np.float32)
ANSWER = np.array([[0.8, -0.4, -0.4], [0.0, 0.7, -0.7]])  # of R, G, B to nx, ny: three lamps
LAMPS = ((1.0, 0.0), (-0.5, 0.9), (-0.5, -0.9))


def model(dark: float) -> PhotometricModel:
    """A light in proportion to the normal; `dark`: how much darker a colour is at most where its lamp is hidden."""
    weights = np.zeros((len(LAMPS), len(SHADOW_SLOPES), 3, 3))
    for lamp in range(3):
        weights[lamp, :, 0, lamp] = -dark / len(SHADOW_SLOPES)
    shadows = CastShadows(lamps=LAMPS, weights=tuple(map(tuple, weights.reshape(-1, 3).tolist()))) if dark else None
    rows = (*map(tuple, ANSWER.tolist()), (0.0, 0.0, 0.0))
    return PhotometricModel(degree=1, position=0, weights=rows, steepest=1.2, shadows=shadows)


def bar() -> np.ndarray:
    along, across = 0.8 * (X - 85) + 0.6 * (Y - 60), 0.8 * (Y - 60) - 0.6 * (X - 85)
    return 7 / (1 + np.exp((np.abs(across) - 9) / 2.5)) / (1 + np.exp((np.abs(along) - 25) / 2.5))


def ball() -> np.ndarray:
    return 9 * np.exp(-((X - 70) ** 2 + (Y - 66) ** 2) / 2 / 12**2)


def seen(height: np.ndarray, of: PhotometricModel) -> np.ndarray:
    """(3, H, W) change of colour of a surface [px]."""
    slopes = np.stack(np.gradient(height)[::-1], axis=-1)
    light = PhotometricLight(of)
    colour = light.change(slopes, U, V, height / np.float32(COLUMNS))[0]
    if of.shadows is not None:

        def at(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            place = [(each * COLUMNS + (n - 1) / 2).astype(np.float32) for each, n in ((x, COLUMNS), (y, ROWS))]
            return cv2.remap(height, *place, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) / np.float32(COLUMNS)

        flat = np.float32(ROWS / COLUMNS)
        colour = colour + light.shadow_change([horizon_slope(at, U, V * flat, lamp) for lamp in of.shadows.lamps], U, V)
    return np.ascontiguousarray(np.moveaxis(colour, -1, 0))


def inverse(change: np.ndarray) -> np.ndarray:
    """(H, W, 2) slopes of each pixel for itself, exact where nothing is hidden."""
    normal = np.einsum("cn,chw->hwn", np.linalg.pinv(ANSWER).astype(np.float32), change)
    normal *= np.minimum(1, 0.8 / np.maximum(np.hypot(normal[..., 0], normal[..., 1]), 1e-9))[..., None]
    return (-normal / np.sqrt(1 - (normal**2).sum(axis=-1, keepdims=True))).astype(np.float32)


def angle(height: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(H, W) between the normals of two surfaces [degrees]."""
    normals = [np.stack([*slopes_of(each, 1.0), -np.ones_like(each)], axis=-1) for each in (height, truth)]
    one, other = (each / np.linalg.norm(each, axis=-1, keepdims=True) for each in normals)
    return np.degrees(np.arccos(np.clip((one * other).sum(axis=-1), -1, 1)))


def both(change: np.ndarray, of: PhotometricModel, hidden: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The height by the inverse, and the better one."""
    integrate = Integrator((ROWS, COLUMNS), 1.0)
    first = integrate(inverse(change))
    steps = ForwardSteps(of, U, V, 1.0, float(COLUMNS))
    return first, steps(
        change, first, np.zeros((ROWS, COLUMNS), dtype=np.bool_) if hidden is None else hidden, integrate
    )


@pytest.mark.parametrize("shape", [bar, ball])
def test_slopes_in_the_shade_are_found(shape: Callable[[], np.ndarray]) -> None:
    truth, light = shape(), model(0.5)
    change = seen(truth, light)
    touched = np.hypot(*np.gradient(truth)) > 0.05
    first, better = (angle(height, truth)[touched].mean() for height in both(change, light))
    assert first > 5.0
    assert better < 0.5 * first


def test_slopes_are_found_where_depth_colours_the_gel() -> None:
    """By its colour alone, the flat bottom of a bar passes for a slope."""
    weights = ((0.25, -0.1, -0.2), *(((0.0, 0.0, 0.0),) * (DEPTH_TERMS - 1)))
    light = model(0.0).model_copy(update={"depth": DepthColour(deepest=8 / COLUMNS, weights=weights)})
    truth = bar()
    change, touched = seen(truth, light), truth > 1.0
    first, better = (angle(height, truth)[touched].mean() for height in both(change, light))
    assert first > 4.0
    assert better < 0.5 * first


def test_slopes_are_found_that_look_otherwise_at_depth() -> None:
    """Deep down a lamp tells twice as much of a slope: by its colour alone a bar's flank passes for a steeper one."""
    weights = ((0.0, 0.0, 0.0),) * DEPTH_TERMS
    plain = model(0.0)
    depth = DepthColour(deepest=8 / COLUMNS, weights=weights, slopes=plain.weights)
    light, truth = plain.model_copy(update={"depth": depth}), bar()
    change, touched = seen(truth, light), truth > 1.0
    first, better = (angle(height, truth)[touched].mean() for height in both(change, light))
    assert first > 4.0
    assert better < 0.5 * first


def test_a_channel_that_no_slope_explains_counts_little() -> None:
    """A speck that glares in one colour."""
    truth, light = ball(), model(0.0)
    change = seen(truth, light)
    touched = np.hypot(*np.gradient(truth)) > 0.05
    assert angle(both(change, light)[1], truth)[touched].mean() < 0.5
    speck = np.hypot(X - 82, Y - 60) < 4
    change[0, speck] += 0.6
    first, better = (angle(height, truth)[speck].mean() for height in both(change, light))
    assert first > 10.0
    assert better < 0.5 * first


def test_hidden_and_untouched_pixels_tell_nothing() -> None:
    truth, light = ball(), model(0.5)
    first, same = both(seen(truth, light), light, np.ones((ROWS, COLUMNS), dtype=np.bool_))
    assert np.array_equal(first, same)
    first, same = both(np.full((3, ROWS, COLUMNS), 0.09, dtype=np.float32), light)
    assert np.array_equal(first, same)

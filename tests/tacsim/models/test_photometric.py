from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError
from scipy.ndimage import gaussian_filter

from tacsim.models.photometric import (
    DEPTH_TERMS,
    DepthColour,
    PhotometricLight,
    PhotometricModel,
    clip_slopes,
    depth_terms,
    image_grid_places,
    normal_terms,
    term_count,
)
from tacsim.models.sensor import Lighting, Markers, SensorGeometry, SensorModel
from tacsim.optics.grid import image_grid
from tacsim.optics.render import Renderer
from tacsim.optics.surface import SurfaceTable, sample_surface
from tests.tacsim.optics.surfaces import dent, flat, make_surface

GEL = (20e-3, 20e-3)
RNG = np.random.default_rng(3)


def model(degree: int, position: int, steepest: float = 0.8, blur: float = 0.0) -> PhotometricModel:
    weights = RNG.normal(0, 0.3, (term_count(degree, position), 3))
    return PhotometricModel(
        degree=degree, position=position, weights=tuple(map(tuple, weights.tolist())), steepest=steepest, blur=blur
    )


@pytest.mark.parametrize(("degree", "position", "count"), [(1, 0, 3), (3, 0, 10), (3, 2, 60), (5, 1, 63)])
def test_number_of_terms(degree: int, position: int, count: int) -> None:
    assert term_count(degree, position) == count


def test_terms_are_the_powers_of_the_normal() -> None:
    gx, gy = 0.3, -0.5
    nz = 1 / np.sqrt(1 + gx**2 + gy**2)
    nx, ny = -gx * nz, -gy * nz
    wanted = [nx, ny, 1 - nz, nx**2, nx * ny, ny**2, nx**3, nx**2 * ny, nx * ny**2, ny**3]
    np.testing.assert_allclose([float(t) for t in normal_terms(np.array([gx, gy]), 3)], wanted)


def test_change_is_the_polynomial_written_out() -> None:
    calibrated = model(2, 1)
    gradient = RNG.uniform(-0.4, 0.4, (20, 30, 2)).astype(np.float32)
    u, v = image_grid_places(30, 20)
    change, beyond = PhotometricLight(calibrated).change(gradient, u, v)
    row, column = 4, 17
    normal = [float(t) for t in normal_terms(gradient[row, column].astype(float), 2)]
    at_u, at_v = (column + 0.5) / 30 - 0.5, (row + 0.5) / 20 - 0.5
    terms = [place * term for place in (1.0, at_u, at_v) for term in normal]
    np.testing.assert_allclose(change[row, column], np.array(terms) @ np.array(calibrated.weights), atol=1e-5)
    assert beyond == 0
    scaled, _ = PhotometricLight(calibrated, (0.5, 1.0, 2.0)).change(gradient[8:12], u[8:12], v[8:12])
    np.testing.assert_allclose(scaled, change[8:12] * [0.5, 1.0, 2.0], atol=1e-6)
    several = np.stack([gradient, -gradient])
    both, _ = PhotometricLight(calibrated).change(several, np.stack([u, u]), np.stack([v, v]))
    np.testing.assert_array_equal(both[0], change)
    np.testing.assert_array_equal(both[1], PhotometricLight(calibrated).change(-gradient, u, v)[0])


def test_slopes_beyond_the_calibrated_are_clipped_and_counted() -> None:
    gradient = np.array([[[3.0, 4.0], [0.3, 0.4]]], dtype=np.float32)
    shorter, beyond = clip_slopes(gradient, 1.0)
    np.testing.assert_allclose(shorter, [[[0.6, 0.8], [0.3, 0.4]]], rtol=1e-6)
    assert beyond == 1
    assert PhotometricLight(model(3, 0, steepest=1.0)).change(gradient, *image_grid_places(2, 1))[1] == 1


def test_the_renderer_uses_it_in_place_of_the_lights() -> None:
    sensor = SensorModel(photometric=model(3, 2, steepest=0.1, blur=0.8), texture=0.0)
    render = Renderer(sensor, GEL)
    base = np.rint(255 * np.array([0.42, 0.44, 0.46]))
    np.testing.assert_array_equal(render(flat()).reshape(-1, 3), np.tile(base, (76800, 1)))
    assert render.clipped_share == 0.0
    seen = render(dent())
    assert np.abs(seen - base).max() > 5
    assert render.clipped_share > 0.01
    phong = Renderer(SensorModel(texture=0.0), GEL)
    phong(dent())
    assert phong.clipped_share == 0.0


@pytest.mark.slow
@pytest.mark.parametrize(("width", "spacing"), [(640, 1e-3), (640, 0.5e-3), (320, 0.5e-3), (160, 0.5e-3)])
def test_light_is_within_half_a_grey_level_of_the_formula(width: int, spacing: float) -> None:
    """Of the polynomial written out term by term at every pixel in double precision, then blurred."""
    rows, blur = 3 * width // 4, 0.8
    geometry = SensorGeometry(width=width, height=rows, pixel_pitch=20e-3 / width)
    rng = np.random.default_rng(5)
    weights = 0.05 * rng.normal(size=(term_count(5, 2), 3))
    weights[:2] = [[0.8, -0.4, -0.4], [0.0, 0.7, -0.7]]  # of a light on the right, and of one below
    calibrated = PhotometricModel(degree=5, position=2, weights=tuple(map(tuple, weights)), steepest=1.0, blur=blur)

    def pressed_and_slid(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        r2 = (x - 2e-3) ** 2 + (y + 1e-3) ** 2
        near = np.exp(-r2 / 4e-3**2)
        return 0.3e-3 * near + 0.05 * (x - 2e-3) * near, -0.2e-3 * near, np.minimum(0.5 * r2 / 4e-3 - 0.8e-3, 0.0)

    surface = make_surface(pressed_and_slid, spacing=spacing)
    gx, gy = np.moveaxis(sample_surface(surface, image_grid(geometry)).gradient.astype(np.float64), -1, 0)
    nz = 1.0 / np.sqrt(1.0 + gx**2 + gy**2)
    nx, ny = -gx * nz, -gy * nz
    powers = [(nx, ny, 1.0 - nz), *([nx ** (n - k) * ny**k for k in range(n + 1)] for n in range(2, 6))]
    u, v = np.meshgrid((np.arange(width) + 0.5) / width - 0.5, (np.arange(rows) + 0.5) / rows - 0.5)
    terms = [place * term for place in (1.0, u, v, u * u, u * v, v * v) for order in powers for term in order]
    change = sum(term[..., None] * weight for term, weight in zip(terms, weights, strict=True))
    untouched = 255.0 * np.array([0.42, 0.44, 0.46])
    wanted = np.clip(untouched + untouched * gaussian_filter(change, (blur, blur, 0), truncate=5.0), 0.0, 255.0)
    render = Renderer(SensorModel(geometry=geometry, photometric=calibrated, texture=0.0), GEL)
    error = np.abs(render(surface) - wanted)
    assert render.clipped_share == 0.0
    assert np.abs(wanted - untouched).max() > 30.0
    assert error.max() < 0.5 + 0.5  # and half a level by rounding to whole ones
    assert error.mean() < 0.21  # by rounding alone it is 0.205: beside the contact the light does not vary


@pytest.mark.parametrize("size", [(20e-3, 20e-3), (11.5e-3, 9e-3)], ids=["gel wider", "picture wider"])
@pytest.mark.parametrize("blur", [0.0, 0.8, 6.0])
def test_blocks_of_pixels_show_what_pixels_show(
    size: tuple[float, float], blur: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With dots and skin, and where the gel ends within the picture."""

    def pressed_and_slid(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        near = np.exp(-((x - 1e-3) ** 2 + (y + 1e-3) ** 2) / 3e-3**2)
        return 0.3e-3 * near, -0.2e-3 * near, -0.5e-3 * near

    picture = np.random.default_rng(2).integers(90, 130, (480, 640, 3)).astype(np.uint8)
    Image.fromarray(picture).save(tmp_path / "background.png")
    sensor = SensorModel(
        geometry=SensorGeometry(width=640, height=480, pixel_pitch=14e-3 / 640),
        lighting=Lighting(background=str(tmp_path / "background.png")),
        photometric=model(3, 2, steepest=1.0, blur=blur),
        markers=Markers(rows=4, columns=4, pitch=2e-3, radius=0.3e-3),
        skin=0.5,
        texture=0.0,
    )
    render, surface = Renderer(sensor, size), make_surface(pressed_and_slid, size)
    blocks = render(surface).astype(float)
    monkeypatch.setattr(SurfaceTable, "points_per_cell", lambda self, grid: 1)
    pixels = render(surface).astype(float)
    assert np.abs(pixels - picture).max() > 30
    off = np.abs(blocks - pixels)
    assert off.mean() < 0.03 and (off > 1.0).sum() < 10  # the skin's grain is looked up to a 32nd of a pixel


def test_texture_shows_as_on_the_flat_gel() -> None:
    sensor = SensorModel(photometric=model(3, 1))
    still = Renderer(sensor, GEL)(flat()).astype(float)
    smooth = sensor.model_copy(update={"texture": 0.0})
    assert still.std(axis=(0, 1)).max() > 0.5
    change = Renderer(smooth, GEL)(dent()).astype(float) - Renderer(smooth, GEL)(flat())
    textured = Renderer(sensor, GEL)(dent()) - still
    unclipped = (still + change > 1) & (still + change < 254)
    np.testing.assert_allclose(textured[unclipped], change[unclipped], atol=1.0)


def test_wrong_models_are_refused() -> None:
    with pytest.raises(ValidationError, match="weights has 3 rows; degree 3 at position 0 has 10"):
        PhotometricModel(degree=3, position=0, weights=((0.0, 0.0, 0.0),) * 3, steepest=1.0)
    with pytest.raises(ValidationError, match=r"needs lighting\.background"):
        SensorModel(photometric=model(1, 0), lighting=Lighting(background=None))


def test_slopes_look_otherwise_at_depth() -> None:
    """Closed form: w n_x of weight 0.3 in red, for a slope of 0.75 (n_x = -0.6) at four depths."""
    light, gradient = model(3, 2), np.zeros((1, 4, 2), dtype=np.float32)
    gradient[..., 0] = 0.75
    rows = ((0.3, 0.0, 0.0), *(((0.0, 0.0, 0.0),) * 9))
    depth = DepthColour(deepest=0.04, weights=((0.0, 0.0, 0.0),) * DEPTH_TERMS, slopes=rows)
    deep = PhotometricLight(light.model_copy(update={"depth": depth}))
    u, v = (np.full((1, 4), value, dtype=np.float32) for value in (0.1, -0.2))
    height = np.array([[-0.01, 0.0, 0.02, 0.1]], dtype=np.float32)
    surface, _ = PhotometricLight(light).change(gradient, u, v)
    np.testing.assert_allclose(deep.change(gradient, u, v)[0], surface, atol=1e-6)
    wanted = np.array([0.0, 0.0, -0.09, -0.18])
    found = deep.change(gradient, u, v, height)[0] - surface
    np.testing.assert_allclose(found[0], np.stack([wanted, 0 * wanted, 0 * wanted], axis=-1), atol=1e-6)
    with pytest.raises(ValidationError, match=r"depth\.slopes has 10 rows; degree 1 has 3, or none"):
        PhotometricModel(**(model(1, 0).model_dump() | {"depth": depth}))


@pytest.mark.parametrize("position", [0, 1, 2])
def test_colour_of_depth_knows_the_place_whether_or_not_slopes_do(position: int) -> None:
    weights = RNG.uniform(-1.0, 1.0, (DEPTH_TERMS, 3))
    depth = DepthColour(deepest=0.05, weights=tuple(map(tuple, weights.tolist())))
    light = PhotometricLight(model(2, position).model_copy(update={"depth": depth}), (0.5, 1.0, 2.0))
    gradient = RNG.uniform(-0.4, 0.4, (4, 6, 2)).astype(np.float32)
    u, v = image_grid_places(6, 4)
    height = RNG.uniform(0.0, 0.05, (4, 6)).astype(np.float32)
    deeper = light.change(gradient, u, v, height)[0] - light.change(gradient, u, v)[0]
    wanted = np.moveaxis(depth_terms(height, 0.05, u, v), 0, -1) @ weights * [0.5, 1.0, 2.0]
    np.testing.assert_allclose(deeper, wanted, atol=1e-5)


def test_flat_gel_that_is_pressed_in_has_the_colour_of_its_depth() -> None:
    """Closed form: a surface pressed in evenly, which has no slope, at three depths; beyond the deepest as there."""
    weights = np.zeros((DEPTH_TERMS, 3))
    weights[0], weights[1], weights[4] = (-0.2, 0.1, 0.0), (0.1, 0.0, 0.0), (0.0, 0.0, 0.1)  # w, w u, w^3
    depth = DepthColour(deepest=1e-3 / (320 * 0.06e-3), weights=tuple(map(tuple, weights.tolist())))
    light = model(3, 2).model_copy(update={"depth": depth})
    geometry = SensorGeometry(width=320, height=240, pixel_pitch=0.06e-3)
    render = Renderer(
        SensorModel(geometry=geometry, lighting=Lighting(background=(0.5, 0.5, 0.5)), photometric=light, texture=0.0),
        GEL,
    )
    u, _ = image_grid_places(320, 240)
    for millimetres in (0.0, 0.5, 1.0, 1.6):
        pressed = make_surface(lambda x, y, h=millimetres: (x * 0, x * 0, x * 0 - h * 1e-3))
        w = min(millimetres, 1.0)
        wanted = 127.5 * (1 + np.stack([-0.2 * w + 0.1 * w * u, 0.1 * w + 0 * u, 0.1 * w**3 + 0 * u], axis=-1))
        assert np.abs(render(pressed) - wanted).max() <= 0.6

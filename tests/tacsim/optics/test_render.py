import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from tacsim.models.sensor import Light, Lighting, SensorGeometry, SensorModel
from tacsim.optics import render
from tacsim.optics.grid import PixelGrid, image_grid
from tacsim.optics.render import Renderer, light_at, light_table, phong_shading, texture_gradient, unlit_image
from tacsim.optics.surface import SurfaceTable, sample_surface
from tacsim.optics.tuning import MAX_SLOPE
from tests.tacsim.optics.surfaces import dent, flat

GEL = (20e-3, 20e-3)
SMOOTH = SensorModel(texture=0.0)


def test_untouched_smooth_gel_is_the_background() -> None:
    image = Renderer(SMOOTH, GEL)(flat())
    assert image.shape == (240, 320, 3)
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(
        image.reshape(-1, 3), np.tile(np.rint(255 * np.array([0.42, 0.44, 0.46])), (76800, 1))
    )


def test_flanks_take_the_colour_of_the_light_they_face() -> None:
    """Red stands on the right (+x), green lower left, blue upper left; the dent lies right of and below the middle."""
    renderer = Renderer(SMOOTH, GEL)
    change = renderer(dent()).astype(int) - renderer(flat()).astype(int)
    v0, u0 = 119.5 + 2e-3 / 0.0625e-3, 159.5 + 3e-3 / 0.0625e-3
    right = change[round(v0), round(u0 + 24)]
    left = change[round(v0), round(u0 - 24)]
    assert right[0] > 20 > -5 > max(right[1], right[2])
    assert left[0] < -20
    assert left[1] > 5
    assert left[2] > 5
    below, above = change[round(v0 + 16), round(u0)], change[round(v0 - 16), round(u0)]
    assert below[1] > 20 > -20 > below[2]
    assert above[2] > 20 > -20 > above[1]
    weight = np.abs(change).sum(axis=2)
    v, u = np.indices(weight.shape)
    np.testing.assert_allclose(((u * weight).sum() / weight.sum(), (v * weight).sum() / weight.sum()), (u0, v0), atol=3)


def test_shading_is_phongs_formula() -> None:
    """Against the formula written out in vectors, one pixel at a time."""
    lighting = Lighting(
        lights=(
            Light(direction=(1.0, 0.4, -0.5), colour=(1.0, 0.3, 0.1), diffuse=0.7, specular=0.9),
            Light(direction=(-2.0, 1.0, -3.0), colour=(0.2, 0.8, 1.0), diffuse=0.4, specular=0.0),
        ),
        shininess=6.5,
    )
    slopes = np.array([(0.0, 0.0), (0.7, -0.2), (-0.4, 0.9), (-1.5, -1.0), (2.5, 0.1)], dtype=np.float32)
    found = phong_shading(slopes[None], lighting)[0]
    view = np.array([0.0, 0.0, -1.0])
    for slope, colour in zip(slopes, found, strict=True):
        normal = np.array([-slope[0], -slope[1], -1.0]) / np.sqrt(1.0 + slope @ slope)
        expected = np.zeros(3)
        for light in lighting.lights:
            towards = np.array(light.direction) / np.linalg.norm(light.direction)
            lit = max(normal @ towards, 0.0)
            mirrored = max((2 * lit * normal - towards) @ view, 0.0)
            expected += np.array(light.colour) * (light.diffuse * lit + light.specular * mirrored**lighting.shininess)
        np.testing.assert_allclose(colour, expected, atol=2e-6)


def test_light_that_is_looked_up_is_within_half_a_grey_level() -> None:
    slopes = np.random.default_rng(2).uniform(-MAX_SLOPE, MAX_SLOPE, (300, 300, 2)).astype(np.float32)
    slopes[0, :4] = [(MAX_SLOPE, MAX_SLOPE), (-MAX_SLOPE, MAX_SLOPE), (MAX_SLOPE, -MAX_SLOPE), (-MAX_SLOPE, -MAX_SLOPE)]
    slopes[1:100] *= 0.05
    for lighting in (SMOOTH.lighting, Lighting(lights=SMOOTH.lighting.lights[:1], shininess=40.0)):
        table = light_table(lighting)
        assert table is not None
        error = light_at(table, slopes) - phong_shading(slopes, lighting, white=255.0)
        assert np.abs(error).max() < 0.6  # half a level, and the look-up's own rounding
        assert np.sqrt(np.mean(error**2)) < 0.05


@pytest.mark.parametrize(("shininess", "depth"), [(10.0, 5e-3), (900.0, 0.8e-3)])
def test_steep_flanks_and_narrow_highlights_are_shaded_pixel_by_pixel(shininess: float, depth: float) -> None:
    model = SMOOTH.model_copy(update={"lighting": Lighting(shininess=shininess)})
    surface = dent(depth=depth)
    steepest = np.abs(sample_surface(surface, image_grid(model.geometry)).gradient).max()
    assert (steepest > MAX_SLOPE) != (light_table(model.lighting) is None)  # one reason at a time
    table = SurfaceTable(surface)
    slopes, _ = table.sample_on_grid(table.fields[..., 1:], image_grid(model.geometry), fine=False)
    exact = 255.0 * unlit_image(model.lighting, slopes.shape[:2]) + phong_shading(slopes, model.lighting, white=255.0)
    image = Renderer(model, GEL)(surface)
    assert np.abs(image - exact.clip(0.0, 255.0)).max() < 0.5 + 1e-3


def test_lights_that_differ_are_tabulated_once_each_and_small_pictures_not_at_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A table takes as long as seven pictures of 320 x 240 px; many sensors, each in a light of its own, take turns."""
    made: list[Lighting] = []

    def counted(lighting: Lighting) -> Any:
        made.append(lighting)
        return light_table.__wrapped__(lighting)

    monkeypatch.setattr(render, "light_table", counted)
    lights = [Lighting(shininess=6.0 + 0.5 * each) for each in range(3)]
    surface = dent()
    small = {"width": 80, "height": 60, "pixel_pitch": 0.25e-3}
    for geometry, tables in ((SMOOTH.geometry, 3), (SMOOTH.geometry.model_copy(update=small), 0)):
        made.clear()
        renderers = [
            Renderer(SMOOTH.model_copy(update={"lighting": light, "geometry": geometry}), GEL) for light in lights
        ]
        for _ in range(2):
            for renderer in renderers:
                renderer(surface)
        assert len(made) == tables


def test_order_of_lights_changes_no_bit() -> None:
    lights = SMOOTH.lighting.lights
    gradient = sample_surface(dent(), image_grid(SMOOTH.geometry)).gradient
    images = [phong_shading(gradient, Lighting(lights=order)) for order in itertools.permutations(lights)]
    for image in images[1:]:
        np.testing.assert_array_equal(image, images[0])


def test_without_background_ambient_and_lights_make_the_picture() -> None:
    light = Light(direction=(0.0, 3.0, -4.0), colour=(1.0, 0.5, 0.0), diffuse=0.5, specular=0.0)
    model = SensorModel(lighting=Lighting(lights=(light,), ambient=0.11, background=None), texture=0.0)
    image = Renderer(model, GEL)(flat())
    np.testing.assert_array_equal(image[7, 9], np.rint(255 * np.array([0.11 + 0.4, 0.11 + 0.2, 0.11])))


def test_background_picture_is_read_as_rgb(tmp_path: Path) -> None:
    from PIL import Image

    picture = np.random.default_rng(0).integers(0, 255, (120, 160, 3)).astype(np.uint8)
    Image.fromarray(picture).save(tmp_path / "gel.png")
    geometry = SensorGeometry(width=160, height=120, pixel_pitch=0.125e-3)
    model = SensorModel(geometry=geometry, lighting=Lighting(background=str(tmp_path / "gel.png")), texture=0.0)
    np.testing.assert_array_equal(Renderer(model, GEL)(flat()), picture)
    with pytest.raises(ValueError, match="is 160 x 120 px, the sensor's image is 320 x 240"):
        Renderer(model.model_copy(update={"geometry": SensorGeometry()}), GEL)
    with pytest.raises(ValueError, match=r"none\.png.*no readable picture"):
        Renderer(model.model_copy(update={"lighting": Lighting(background=str(tmp_path / "none.png"))}), GEL)


def test_texture_is_fixed_by_its_seed_and_shared_by_all_frames() -> None:
    surface = dent()
    first, again = Renderer(SensorModel(), GEL)(surface), Renderer(SensorModel(), GEL)(surface)
    np.testing.assert_array_equal(first, again)
    other = Renderer(SensorModel(texture_seed=1), GEL)(surface)
    assert (first != other).mean() > 0.5
    renderer = Renderer(SensorModel(), GEL)
    change = renderer(surface).astype(int) - renderer(flat()).astype(int)
    assert np.abs(change[:60, :60]).max() <= 1  # far from the dent the texture cancels
    assert renderer(flat())[:60, :60].std() > 2.0  # though it is there


def test_texture_belongs_to_the_gel_not_to_the_image() -> None:
    fine = PixelGrid(rows=120, columns=160, pitch=0.05e-3, x0=-4e-3, y0=-3e-3)
    coarse = PixelGrid(rows=60, columns=80, pitch=0.1e-3, x0=-4e-3, y0=-3e-3)
    texture = texture_gradient(fine, GEL, 2e-6, seed=5)
    np.testing.assert_allclose(texture_gradient(coarse, GEL, 2e-6, seed=5), texture[::2, ::2], atol=1e-5)
    # white noise of 2 um on 54.3 um pixels has central differences of 2e-6 / (sqrt(2) 54.3e-6) = 0.026 (Gomes)
    assert texture.std() == pytest.approx(0.0226, rel=0.1)
    line = texture_gradient(PixelGrid(rows=40, columns=1600, pitch=0.01e-3, x0=-8e-3, y0=-8e-3), GEL, 2e-6, seed=5)
    height = np.cumsum(line[..., 0], axis=1) * 0.01e-3
    assert (height - height.mean(axis=1, keepdims=True)).std() == pytest.approx(2e-6, rel=0.2)
    assert not texture_gradient(fine, (2e-3, 2e-3), 2e-6, seed=5)[0].any()


@pytest.mark.parametrize(("width", "height"), [(160, 120), (320, 240), (640, 480)])
def test_image_sizes_show_the_same_scene(width: int, height: int) -> None:
    pitch = 20e-3 / width
    geometry = SensorGeometry(width=width, height=height, pixel_pitch=pitch)
    model = SensorModel(geometry=geometry, texture=0.0)
    image = Renderer(model, GEL)(dent())
    assert image.shape == (height, width, 3)
    block = width // 160
    small = image.reshape(120, block, 160, block, 3).mean(axis=(1, 3))
    reference = SensorModel(geometry=SensorGeometry(width=160, height=120, pixel_pitch=0.125e-3), texture=0.0)
    np.testing.assert_allclose(small, Renderer(reference, GEL)(dent()), atol=3.0)


def test_light_that_cannot_reach_the_gel_is_refused() -> None:
    with pytest.raises(ValidationError, match="lights stand behind the gel"):
        Light(direction=(1.0, 0.0, 0.45), colour=(1.0, 1.0, 1.0))
    with pytest.raises(ValidationError, match="ambient has no effect where there is a background"):
        Lighting(ambient=0.2)

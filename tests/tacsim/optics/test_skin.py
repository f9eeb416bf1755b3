from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError

from tacsim.models.scene import GelSurface
from tacsim.models.sensor import Lighting, Markers, SensorGeometry, SensorModel
from tacsim.optics.ink import high_pass, separate_skin
from tacsim.optics.render import Renderer
from tests.tacsim.optics.surfaces import flat, make_surface

GEL, PITCH = (20e-3, 16e-3), 0.08e-3
SHIFT = (4, -3)  # by which the gel is sheared [px]


@pytest.fixture
def untouched(tmp_path: Path) -> tuple[Path, np.ndarray]:
    """A picture of an untouched gel: uneven light, and grain."""
    v, u = np.mgrid[:160, :200]
    light = np.array([120, 110, 100]) + 0.2 * np.stack([u - 100, v - 80, 100 - u], axis=-1)
    grain = np.random.default_rng(0).normal(0, 3, (160, 200, 1))
    picture = np.clip(np.rint(light + grain), 0, 255).astype(np.uint8)
    Image.fromarray(picture).save(tmp_path / "untouched.png")
    return tmp_path / "untouched.png", picture


def model(path: Path, skin: float, **more: object) -> SensorModel:
    geometry = SensorGeometry(width=200, height=160, pixel_pitch=PITCH)
    return SensorModel(geometry=geometry, lighting=Lighting(background=str(path)), texture=0.0, skin=skin, **more)


def sheared() -> GelSurface:
    """The whole gel moved sideways: no slope anywhere."""
    return make_surface(lambda x, y: (0 * x + SHIFT[0] * PITCH, 0 * x + SHIFT[1] * PITCH, 0 * x))


def test_untouched_gel_is_the_picture_to_the_bit(untouched: tuple[Path, np.ndarray]) -> None:
    path, picture = untouched
    np.testing.assert_array_equal(Renderer(model(path, 0.7), GEL)(flat()), picture)


@pytest.mark.parametrize("skin", [0.0, 0.6, 1.0])
def test_skin_moves_with_the_gel_and_light_stays(untouched: tuple[Path, np.ndarray], skin: float) -> None:
    path, picture = untouched
    seen = Renderer(model(path, skin), GEL)(sheared())[20:-20, 20:-20].astype(float)
    grain = high_pass(picture.astype(np.float32), PITCH)
    light = (picture - grain)[20:-20, 20:-20]
    moved = np.roll(grain, SHIFT[::-1], axis=(0, 1))[20:-20, 20:-20]
    grain = grain[20:-20, 20:-20]
    # to rounding, and to how much brighter the light is 5 pixels farther on, of which the skin lets a share through
    assert np.abs(seen - (light + skin * moved + (1 - skin) * grain)).max() < 1.0
    assert np.abs(moved - grain).std() > 2.0


def test_drawn_dots_lie_on_the_skin(untouched: tuple[Path, np.ndarray]) -> None:
    path, _ = untouched
    markers = Markers(rows=3, columns=3, pitch=3e-3)
    surface = sheared()
    dotted = Renderer(model(path, 1.0, markers=markers), GEL)(surface).astype(float)
    bare = Renderer(model(path, 1.0), GEL)(surface).astype(float)
    without = Renderer(model(path, 0.0, markers=markers), GEL)(surface).astype(float)
    dark = dotted < 0.5 * bare
    assert dark.any() and (dark == (without < 0.5 * Renderer(model(path, 0.0), GEL)(surface))).all()
    np.testing.assert_array_equal(dotted[~dark.any(axis=2)][:2000], bare[~dark.any(axis=2)][:2000])


def test_what_lets_no_light_through_stays_finite() -> None:
    picture = np.zeros((40, 50, 3), dtype=np.float32)
    picture[10, 10] = 200
    clean, share = separate_skin(picture, 1.0, PITCH)
    assert np.isfinite(share).all() and (clean > 0).all()
    np.testing.assert_allclose(clean * share, picture, atol=1e-3)


def test_skin_needs_a_picture(untouched: tuple[Path, np.ndarray]) -> None:
    with pytest.raises(ValidationError, match="no picture that could show it"):
        SensorModel(skin=0.5)
    far = SensorGeometry(width=200, height=160, pixel_pitch=PITCH, camera_distance=30e-3)
    with pytest.raises(ValidationError, match="parallel rays"):
        SensorModel(geometry=far, lighting=Lighting(background=str(untouched[0])), skin=0.5)

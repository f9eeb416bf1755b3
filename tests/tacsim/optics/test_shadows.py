import numpy as np
import pytest

from tacsim.models.photometric import (
    SHADOW_PLACES,
    SHADOW_SLOPES,
    SHADOW_STEPS,
    SHADOW_WIDTH,
    CastShadows,
    PhotometricModel,
)
from tacsim.models.scene import GelSurface
from tacsim.models.sensor import Lighting, SensorGeometry, SensorModel
from tacsim.optics.grid import image_grid
from tacsim.optics.render import Renderer
from tacsim.optics.surface import sample_surface
from tests.tacsim.optics.surfaces import dent, flat, make_surface

GEL = (20e-3, 20e-3)
GEOMETRY = SensorGeometry(width=320, height=240, pixel_pitch=0.06e-3)
LAMPS = ((1.5, 0.4), (-0.4, -0.3), (0.0, 0.9))
LIGHT = PhotometricModel(degree=1, position=0, weights=((0.0, 0.0, 0.0),) * 3, steepest=2.0)
DARK = np.zeros((3, len(SHADOW_SLOPES), SHADOW_PLACES, 3))
for lamp in range(3):
    DARK[lamp, :, 0, lamp] = (-0.4, -0.2, -0.1)  # each lamp is of one colour
    DARK[lamp, 0, 1, lamp] = 0.2
SHADOWS = CastShadows(lamps=LAMPS, weights=tuple(map(tuple, DARK.reshape(-1, 3).tolist())))


def renderer(shadows: CastShadows | None) -> Renderer:
    light = LIGHT.model_copy(update={"shadows": shadows})
    lighting = Lighting(background=(0.5, 0.5, 0.5))
    return Renderer(SensorModel(geometry=GEOMETRY, lighting=lighting, photometric=light, texture=0.0), GEL)


def bar(depth: float = 0.9e-3) -> GelSurface:
    """A bar that lies askew: nothing is round about it."""

    def displace(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        along, across = 0.8 * x + 0.6 * y, 0.8 * y - 0.6 * x
        shape = 1 / (1 + np.exp((np.abs(across) - 1.2e-3) / 0.25e-3)) / (1 + np.exp((np.abs(along) - 3e-3) / 0.25e-3))
        return x * 0, x * 0, -depth * shape

    return make_surface(displace)


@pytest.mark.parametrize("surface", [bar(), dent()], ids=["a bar", "an oval dent, spread sideways"])
def test_shadows_are_those_of_the_surface(surface: GelSurface) -> None:
    """Truth: the way to the lamps followed pixel by pixel, at ten times as many distances."""
    from scipy.ndimage import map_coordinates

    grid = image_grid(GEOMETRY)
    whole = sample_surface(surface, grid).height.astype(float) / (GEOMETRY.width * GEOMETRY.pixel_pitch)
    rows, columns = np.mgrid[1:240:6, 1:320:6].astype(float)
    x, y = (columns - 159.5) / 320, (rows - 119.5) / 320
    height, change = whole[1::6, 1::6], np.zeros((*rows.shape, 3))
    for lamp, (lamp_x, lamp_y) in enumerate(LAMPS):
        way = np.hypot(lamp_x - x, lamp_y - y)
        towards = np.zeros_like(x)
        for step in np.geomspace(SHADOW_STEPS[0], SHADOW_STEPS[-1], 140):
            at = [rows + 320 * step * (lamp_y - y) / way, columns + 320 * step * (lamp_x - x) / way]
            there = map_coordinates(whole, at, order=1, mode="nearest")
            towards = np.maximum(towards, (there - height) / step)
        for slope, weights in zip(SHADOW_SLOPES, DARK[lamp], strict=True):
            ramp = np.clip((towards - slope) / (slope * (SHADOW_WIDTH - 1)), 0, 1)
            change += ramp[..., None] * (weights[0] + weights[1] * x[..., None] + weights[2] * (y * 4 / 3)[..., None])
    true = np.clip(127.5 + 127.5 * change, 0, 255)
    seen = renderer(SHADOWS)(surface)[1::6, 1::6].astype(float)
    dark = np.abs(true - 127.5) > 5
    assert 0.02 < dark.mean() < 0.5
    assert np.abs(true - 127.5)[dark].mean() > 35
    assert np.abs(seen - true)[dark].mean() < 4.0
    assert np.abs(seen - true)[~dark].mean() < 0.7  # 0.5 is rounding


def test_an_untouched_gel_has_no_shadows() -> None:
    np.testing.assert_array_equal(renderer(SHADOWS)(flat()), renderer(None)(flat()))


def test_the_same_surface_in_another_size_has_the_same_shadows() -> None:
    small = SensorGeometry(width=160, height=120, pixel_pitch=0.12e-3)
    model = renderer(SHADOWS).model
    coarse = Renderer(model.model_copy(update={"geometry": small}), GEL)(bar()).astype(float)
    fine = renderer(SHADOWS)(bar()).reshape(120, 2, 160, 2, 3).mean(axis=(1, 3))
    assert np.abs(coarse - fine).mean() < 0.3

"""What is found in a picture against what the simulator knows of the same surface."""

from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from calibration.frame_normaliser import FrameNormaliser
from calibration.height.slopes import table_of_model
from calibration.height.surface_finder import SurfaceFinder, extended_view
from calibration.normaliser import normaliser_for_camera, normaliser_for_pictures, normaliser_for_simulation
from tacsim.interface import TactileFrame, TactileObservation
from tacsim.models.hardware import CameraSensorConfig
from tacsim.models.scene import GelSurface
from tacsim.models.sensor import CanonicalGrid, Markers, SensorGeometry, SensorModel
from tacsim.optics.render import Renderer
from tacsim.optics.surface import surface_map
from tests.tacsim.optics.surfaces import dent, flat, make_surface

GEL = (20e-3, 20e-3)
GRID = CanonicalGrid()
MODEL = SensorModel()


def box(depth: float, centre: tuple[float, float] = (0.0, 0.0), bulge: float = 0.06) -> GelSurface:
    """A flat punch of 10 x 10 mm: steep flanks, a flat middle, and a bulge round it."""

    def displace(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        side = np.maximum(np.abs(x - centre[0]), np.abs(y - centre[1]))
        ramp = np.clip((6.2e-3 - side) / 2e-3, 0.0, 1.0)
        lip = np.exp(-(((side - 6.6e-3) / 0.5e-3) ** 2))  # over before the border of the picture, which is zero
        return x * 0, x * 0, -depth * (ramp * ramp * (3 - 2 * ramp) - bulge * lip)

    return make_surface(displace)


def ball(depth: float, centre: tuple[float, float] = (0.0, 0.0)) -> GelSurface:
    """A ball of 5 mm pressed in, with the free surface of Hertz round it, faded out towards the rim."""

    def displace(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        r = np.hypot(x - centre[0], y - centre[1])
        a = np.sqrt(5e-3 * depth)
        q = np.maximum(r / a, 1.0)
        outside = depth / np.pi * ((2 - q**2) * np.arcsin(1 / q) + np.sqrt(q * q - 1))
        return x * 0, x * 0, -np.where(r < a, depth - r**2 / 10e-3, outside) * np.exp(-((r / 5e-3) ** 4))

    return make_surface(displace)


def frame(image: np.ndarray, surface: GelSurface | None = None, model: SensorModel = MODEL) -> TactileFrame:
    known = None if surface is None else surface_map(surface, GRID, model.markers)
    return TactileFrame(image=image, time=0.0, index=0, surface=known)


def jpeg(image: np.ndarray) -> np.ndarray:
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1], cv2.IMREAD_COLOR)


def both(surface: GelSurface, model: SensorModel = MODEL, sent=lambda image: image):
    """The observation that knows the surface, and the one that sees only the picture as it is `sent`."""
    render = Renderer(model, GEL)
    seen: list[TactileObservation] = []
    for normalise, shown in (
        (normaliser_for_simulation(model, GEL, GRID), surface),
        (normaliser_for_pictures(model, GEL, GRID), None),
    ):
        normalise.take_reference(frame(sent(render(flat()))))
        seen.append(normalise(frame(sent(render(surface)), shown, model), now=0.0))
        assert normalise.out_of_range_share == 0.0
    return seen


def angles(one: TactileObservation, other: TactileObservation) -> np.ndarray:
    """Between the normals of two observations, in valid cells [degrees]."""
    normals = []
    for observation in (one, other):
        slope = observation.gradient[observation.valid]
        normals.append(np.concatenate([slope, np.ones((len(slope), 1))], axis=1))
    sine = np.linalg.norm(np.cross(*normals), axis=1) / np.prod([np.linalg.norm(n, axis=1) for n in normals], axis=0)
    return np.degrees(np.arcsin(np.clip(sine, 0, 1)))


def cases() -> Iterator[tuple[str, GelSurface]]:
    yield "shallow box", box(0.06e-3)
    yield "box", box(0.25e-3)
    yield "deep box", box(0.5e-3)
    yield "box off the middle", box(0.3e-3, centre=(1.2e-3, -0.8e-3))
    yield "ball", ball(0.2e-3)
    yield "deep ball off the middle", ball(0.6e-3, centre=(2e-3, 1.5e-3))
    yield "slide", dent(depth=0.4e-3, slide=(0.5e-3, -0.3e-3))


@pytest.mark.parametrize("sent", [lambda image: image, jpeg], ids=["as it is", "by JPEG"])
@pytest.mark.parametrize("surface", [s for _, s in cases()], ids=[n for n, _ in cases()])
def test_the_picture_tells_the_same_surface_as_the_simulator_knows(surface: GelSurface, sent) -> None:
    known, seen = both(surface, sent=sent)
    np.testing.assert_array_equal(known.valid, seen.valid)
    np.testing.assert_array_equal(known.image, seen.image)
    deepest = [float(o.height[o.valid].max()) for o in (known, seen)]
    assert deepest[1] == pytest.approx(deepest[0], abs=max(15e-6, 0.03 * deepest[0]))
    assert np.sqrt(((known.height - seen.height)[known.valid] ** 2).mean()) < 12e-6
    assert angles(known, seen).mean() < 0.5
    assert np.quantile(angles(known, seen), 0.99) < 1.5
    assert seen.height.dtype == seen.gradient.dtype == np.float32


def test_contact_is_where_it_is_deep_also_in_its_flat_middle() -> None:
    known, seen = both(box(0.3e-3))
    assert seen.contact[32, 32]
    assert (known.contact & seen.contact).sum() / (known.contact | seen.contact).sum() > 0.95


@pytest.mark.parametrize("surface", [s for _, s in cases()], ids=[n for n, _ in cases()])
def test_printed_dots_are_no_dents(surface: GelSurface) -> None:
    """They move with the gel, and darken the mean of the reference."""
    known, seen = both(surface, SensorModel(markers=Markers()), sent=jpeg)
    deepest = [float(o.height[o.valid].max()) for o in (known, seen)]
    assert deepest[1] == pytest.approx(deepest[0], abs=max(15e-6, 0.03 * deepest[0]))
    assert np.sqrt(((known.height - seen.height)[known.valid] ** 2).mean()) < 12e-6
    assert angles(known, seen).mean() < 0.6


def test_a_frame_that_knows_its_surface_is_believed() -> None:
    normalise = normaliser_for_pictures(MODEL, GEL, GRID)
    render = Renderer(MODEL, GEL)
    normalise.take_reference(frame(render(flat())))
    known = frame(render(ball(0.3e-3)), ball(0.3e-3))
    assert normalise(known, now=0.0).height is known.surface.height


def test_a_dimmer_lamp_gives_the_same_height() -> None:
    heights = []
    for gain in (1.0, 0.7):
        _, seen = both(ball(0.4e-3), sent=lambda image, gain=gain: np.rint(image * gain).astype(np.uint8))
        heights.append(seen.height)
    np.testing.assert_allclose(heights[0], heights[1], atol=6e-6)


def test_another_camera_of_the_same_gel() -> None:
    """Finer pixels, another centre, a gel smaller than the picture."""
    model = SensorModel(geometry=SensorGeometry(width=640, height=480, pixel_pitch=0.04e-3, centre=(300.0, 250.0)))
    known, seen = both(ball(0.4e-3, centre=(1e-3, 0.5e-3)), model)
    assert float(seen.height.max()) == pytest.approx(float(known.height[known.valid].max()), rel=0.03)


def test_a_camera_with_a_model_finds_height_and_one_with_corners_does_not() -> None:
    normalise = normaliser_for_camera(CameraSensorConfig(driver="camera", source="x", model=MODEL), GEL, GRID)
    assert normalise.finds_height
    corners = ((0.0, 0.0), (639.0, 0.0), (639.0, 479.0), (0.0, 479.0))
    blind = normaliser_for_camera(CameraSensorConfig(driver="camera", source="x", corners=corners), GEL, GRID)
    assert not blind.finds_height
    image = np.full((480, 640, 3), 90, dtype=np.uint8)
    blind.take_reference(frame(image))
    assert blind(frame(image), now=0.0).height is None


def test_colours_that_no_slope_has_are_counted() -> None:
    normalise = normaliser_for_pictures(MODEL, GEL, GRID)
    image = Renderer(MODEL, GEL)(flat())
    normalise.take_reference(frame(image))
    normalise(frame(image), now=0.0)
    assert normalise.out_of_range_share == 0.0
    spoiled = image.copy()
    spoiled[100:140, 100:160] = 255
    seen = normalise(frame(spoiled), now=0.0)
    assert normalise.out_of_range_share == pytest.approx(40 * 60 / (240 * 320), rel=0.1)
    assert np.isfinite(seen.height).all()


def test_a_lamp_that_drifts_is_no_dent() -> None:
    """A sensor that was calibrated has a real lamp: a change that is smooth over all the gel is taken for its drift."""
    wide = normaliser_for_pictures(MODEL, GEL, GRID)
    valid = wide._rectify.valid
    slopes = table_of_model(MODEL)
    found = []
    for drifts in (False, True):
        normalise = FrameNormaliser(wide._rectify, GRID, SurfaceFinder(slopes, valid, GRID, dots=False, drifts=drifts))
        normalise.take_reference(frame(Renderer(MODEL, GEL)(flat())))
        image = Renderer(MODEL, GEL)(ball(0.4e-3)).astype(float)
        ramp = np.linspace(-6, 6, 320)[None, :, None] + np.array([4.0, -2.0, 0.0])
        found.append(normalise(frame(np.rint(np.clip(image + ramp, 0, 255)).astype(np.uint8)), now=0.0).height)
    _, true = both(ball(0.4e-3))
    spoiled, mended = (float(np.abs(height - true.height).max()) for height in found)
    assert spoiled > 60e-6
    assert mended < 35e-6  # the gel's own gentle slopes far from the contact pass for drift


def test_the_view_is_the_canonical_image_made_wider() -> None:
    wide = extended_view(GRID, GEL)
    assert wide.shape == (160, 160)
    assert extended_view(GRID, (10e-3, 6e-3)).shape == (128, 128)
    with pytest.raises(ValueError, match="canonical image has"):
        FrameNormaliser(normaliser_for_pictures(MODEL, GEL, GRID)._rectify, GRID)


def test_slopes_that_no_surface_has_are_not_told() -> None:
    """Slopes that turn round a place are the gradient of nothing: of a dent with such an error the dent is told."""
    rows, columns = GRID.rows * GRID.image_scale, GRID.columns * GRID.image_scale
    y, x = np.mgrid[:rows, :columns].astype(np.float32)
    x, y = x - columns / 2, y - rows / 2
    hill = np.exp(-(x**2 + y**2) / (2 * (rows / 8) ** 2)).astype(np.float32)
    dent_slopes = np.stack([-x, -y], axis=-1) * (hill / (rows / 8))[..., None]
    turning = np.stack([-y, x], axis=-1) * (hill / (rows / 8))[..., None]

    def slopes(change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return dent_slopes + 0.5 * turning, np.zeros((rows, columns), dtype=np.bool_)

    find = SurfaceFinder(slopes, np.ones((rows, columns), dtype=np.bool_), GRID, dots=False)
    found = find(np.zeros((rows, columns, 3), np.float32), np.ones((rows, columns, 3), np.float32))
    size = (GRID.columns, GRID.rows)
    true = np.stack([cv2.resize(dent_slopes[..., k], size, interpolation=cv2.INTER_AREA) for k in (0, 1)], axis=-1)
    assert np.abs(found.gradient - true).max() < 0.005  # 0.3 before

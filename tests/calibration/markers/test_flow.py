"""Flow found in pictures against what is known of the same surface."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from calibration.frame_normaliser import FrameNormaliser
from calibration.lens.rectification import Rectification, rectification_of_corners, rectification_of_geometry
from calibration.markers.flow import MarkerFlow, NoMarkers, TooFewMarkers, find_markers, marker_grid
from calibration.normaliser import normaliser_for_camera, normaliser_for_pictures, normaliser_for_simulation
from calibration.reference import UnusableReference
from tacsim.interface import TactileFrame
from tacsim.models.hardware import CameraSensorConfig
from tacsim.models.scene import GelSurface
from tacsim.models.sensor import CanonicalGrid, Lighting, Markers, SensorGeometry, SensorModel
from tacsim.optics.markers import marker_flow, rest_positions
from tacsim.optics.render import Renderer
from tacsim.optics.surface import surface_map
from tests.calibration.dotted import draw, lattice_points, uneven
from tests.tacsim.optics.surfaces import dent, flat, make_surface

GEL = (20e-3, 20e-3)
GRID = CanonicalGrid()
MARKERS = Markers()
MODEL = SensorModel(markers=MARKERS)
PITCH_PX = 1.5e-3 / 0.0625e-3


def frame(image: np.ndarray, index: int = 0) -> TactileFrame:
    return TactileFrame(image=image, time=0.0, index=index)


def drag(far: tuple[float, float], depth: float = 0.4e-3, width: float = 4e-3) -> GelSurface:
    """A dent that drags the gel along."""

    def displace(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        shape = np.exp(-((x - 1e-3) ** 2 + y**2) / width**2)
        return far[0] * shape, far[1] * shape, -depth * shape

    return make_surface(displace)


def twist(angle: float, depth: float = 0.3e-3) -> GelSurface:
    def displace(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        shape = np.exp(-(x**2 + y**2) / (3.5e-3) ** 2)
        c, s = np.cos(angle * shape) - 1, np.sin(angle * shape)
        return x * c - y * s, x * s + y * c, -depth * shape

    return make_surface(displace)


STORIES: dict[str, list[GelSurface]] = {
    "press": [dent(depth=d * 1e-3) for d in (0.0, 0.2, 0.4, 0.6, 0.8)],
    "shear": [drag((0.2e-3 * k, -0.1e-3 * k)) for k in range(6)],
    "twist": [twist(0.08 * k) for k in range(6)],
    "slip": [drag((0.3e-3 * min(k, 4), 0.0), depth=0.3e-3) for k in range(4)] + [drag((0.5e-3, 0.0)), drag((0.0, 0.0))],
}


def errors(model: SensorModel, story: list[GelSurface], sent: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """(frames, rows, columns) distance between the flow found in the picture and that of the surface [m]."""
    render = Renderer(model, GEL)
    normalise = normaliser_for_pictures(model, GEL, GRID)
    normalise.take_reference(frame(sent(render(flat()))))
    found = []
    for k, surface in enumerate(story):
        seen = normalise(frame(sent(render(surface)), k + 1), now=0.0)
        assert seen.flow is not None
        assert seen.flow.dtype == np.float32
        assert model.markers is not None
        found.append(np.linalg.norm(seen.flow - marker_flow(surface, model.markers), axis=2))
        assert normalise.visible_marker_share == 1.0
    return np.array(found)


def jpeg(image: np.ndarray) -> np.ndarray:
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1], cv2.IMREAD_COLOR)


@pytest.mark.parametrize("name", STORIES)
def test_the_picture_tells_the_same_flow_as_the_simulator_knows(name: str) -> None:
    found = errors(MODEL, STORIES[name], lambda image: image)
    assert np.median(found) < 3e-6
    assert np.quantile(found, 0.95) < 8e-6
    assert found.max() < 30e-6


def test_compression_and_a_pinhole_cost_little() -> None:
    near = SensorModel(markers=MARKERS, geometry=SensorGeometry(camera_distance=20e-3))
    assert np.median(errors(MODEL, STORIES["shear"], jpeg)) < 5e-6
    assert np.quantile(errors(near, STORIES["press"], lambda image: image), 0.95) < 10e-6
    assert np.quantile(errors(near, STORIES["shear"], lambda image: image), 0.95) < 10e-6


def test_without_its_distance_a_pinhole_would_be_seen_as_motion() -> None:
    """The correction above is no formality: a dot 0.8 mm nearer at 20 mm looks 4 % farther out."""
    near = SensorModel(markers=MARKERS, geometry=SensorGeometry(camera_distance=20e-3))
    render = Renderer(near, GEL)
    normalise = normaliser_for_pictures(MODEL, GEL, GRID)
    normalise.take_reference(frame(render(flat())))
    surface = dent(depth=0.8e-3)
    flow = normalise(frame(render(surface), 1), now=0.0).flow
    assert flow is not None
    assert np.linalg.norm(flow - marker_flow(surface, MARKERS), axis=2).max() > 80e-6


def test_fast_path_and_picture_have_the_same_lattice() -> None:
    surface = drag((0.5e-3, -0.2e-3))
    render = Renderer(MODEL, GEL)
    known = TactileFrame(render(surface), time=0.0, index=1, surface=surface_map(surface, GRID, MARKERS))
    seen = []
    for normalise, shown in (
        (normaliser_for_simulation(MODEL, GEL, GRID), known),
        (normaliser_for_pictures(MODEL, GEL, GRID), None),
    ):
        normalise.take_reference(frame(render(flat())))
        seen.append(normalise(shown or frame(known.image, 1), now=0.0).flow)
    assert seen[0].shape == seen[1].shape == (9, 11, 2)
    np.testing.assert_allclose(seen[0], seen[1], atol=20e-6)


# ---- hidden truth by another drawing, on pixels of 0.0625 mm -------------------------------------------------------


def in_pixels(points: np.ndarray) -> np.ndarray:
    return points / 0.0625e-3 + (159.5, 119.5)


def plain_flow() -> MarkerFlow:
    grid = marker_grid(MARKERS, GEL)
    return MarkerFlow(MARKERS, rectification_of_geometry(SensorGeometry(), GEL, grid), grid)


def moved(far: float) -> np.ndarray:
    rest = rest_positions(MARKERS)
    return np.exp(-(rest**2).sum(axis=2) / (4e-3) ** 2)[..., None] * np.array([far, -0.4 * far])


@pytest.mark.slow
@pytest.mark.parametrize("drop", [0.0, 0.3])
def test_drop_outs_are_filled_and_flagged(drop: float) -> None:
    rng = np.random.default_rng(3)
    flow = plain_flow()
    rest = rest_positions(MARKERS)
    flow.take_reference(draw(in_pixels(rest), 4.0, light=uneven(), noise=1.5))
    for step in range(1, 7):
        true = moved(0.2e-3 * step)
        there = rng.random((9, 11)) >= drop
        found = flow(draw(in_pixels(rest + true)[there], 4.0, light=uneven(), noise=1.5), step)
        assert np.isfinite(found).all()
        error = np.linalg.norm(found - true, axis=2)
        assert np.median(error[there]) < 5e-6
        assert (error[there] < 0.1e-3).mean() > 0.97
        assert flow.visible_share == pytest.approx(there.mean(), abs=0.03)
        assert not flow.visible[~there].any()
        if drop:
            assert np.median(error[~there]) < 0.12e-3  # neighbours' mean, 1.2 mm dragged


def test_dirt_is_no_marker() -> None:
    rng = np.random.default_rng(0)
    flow, rest = plain_flow(), in_pixels(rest_positions(MARKERS))
    flow.take_reference(draw(rest, 4.0))
    dirt = np.stack([rng.uniform(0, 320, 12), rng.uniform(0, 240, 12)], axis=1)
    true = moved(0.6e-3)
    points = np.concatenate([in_pixels(rest_positions(MARKERS) + true).reshape(-1, 2), dirt])
    found = flow(draw(points, 4.0), 1)
    assert (np.linalg.norm(found - true, axis=2) < 20e-6).mean() > 0.85  # some dirt touches a dot
    assert np.median(np.linalg.norm(found - true, axis=2)) < 5e-6


@pytest.mark.slow
@pytest.mark.parametrize("jump", [1.5, 2.0])
def test_a_jump_in_time_and_place_keeps_who_is_who(jump: float) -> None:
    """All dots 1.5 pitches on, 50 frames later; those that left the picture are lost, none is taken for another."""
    flow, rest = plain_flow(), rest_positions(MARKERS)
    flow.take_reference(draw(in_pixels(rest), 4.0))
    shift = np.array([0.0, jump * MARKERS.pitch])
    found = flow(draw(in_pixels(rest + shift), 4.0), 50)
    assert np.linalg.norm(found - shift, axis=2).max() < 0.05e-3
    back = flow(draw(in_pixels(rest), 4.0), 3)  # an index that goes backwards: another episode
    assert np.abs(back).max() < 5e-6
    assert flow.visible_share == 1.0


@pytest.mark.slow
def test_a_fresh_reference_is_rest() -> None:
    flow, rest = plain_flow(), rest_positions(MARKERS)
    flow.take_reference(draw(in_pixels(rest), 4.0))
    flow(draw(in_pixels(rest + moved(1e-3)), 4.0), 1)
    crept = rest + moved(0.2e-3)
    flow.take_reference(draw(in_pixels(crept), 4.0), index=2)
    assert np.abs(flow(draw(in_pixels(crept), 4.0), 3)).max() < 1e-9
    np.testing.assert_allclose(flow(draw(in_pixels(rest), 4.0), 4), -moved(0.2e-3), atol=8e-6)


def test_a_gel_printed_askew_and_aside_is_followed_from_where_it_rests() -> None:
    rest = lattice_points(9, 11, MARKERS.pitch, angle=0.12) * 0.93 + (0.5e-3, -0.3e-3)
    flow = plain_flow()
    flow.take_reference(draw(in_pixels(rest), 4.0))
    np.testing.assert_allclose(flow(draw(in_pixels(rest + moved(0.4e-3)), 4.0), 1), moved(0.4e-3), atol=12e-6)


def through_corners(angle: float) -> tuple[Rectification, np.ndarray]:
    """The map of a camera turned by `angle` [rad] and looking askew at a gel of 20 x 15 mm, and its (3, 3)."""
    gel = np.array([(-10, -7.5), (10, -7.5), (10, 7.5), (-10, 7.5)])
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    corners = gel @ turn * 20 * (1 + 0.012 * gel[:, :1]) + (320.0, 320.0)
    grid = marker_grid(MARKERS, (20e-3, 15e-3))
    rectify = rectification_of_corners(tuple(map(tuple, corners)), (20e-3, 15e-3), (640, 640), grid)  # type: ignore[arg-type]
    return rectify, cv2.getPerspectiveTransform(gel.astype(np.float32), corners.astype(np.float32))


@pytest.mark.parametrize("angle", [0.0, 0.5, np.pi / 2, 2.8])
def test_a_rotated_camera_tells_flow_in_the_axes_of_the_sensor(angle: float) -> None:
    rectify, image_from_gel = through_corners(angle)
    flow = MarkerFlow(MARKERS, rectify, marker_grid(MARKERS, (20e-3, 15e-3)))

    def photograph(points: np.ndarray) -> np.ndarray:
        at = cv2.perspectiveTransform(points.reshape(1, -1, 2) * 1e3, image_from_gel)
        return draw(at, 5.0, shape=(640, 640))

    rest = rest_positions(MARKERS)
    flow.take_reference(photograph(rest))
    assert flow.visible_share == 1.0
    np.testing.assert_allclose(flow(photograph(rest + moved(0.5e-3)), 1), moved(0.5e-3), atol=15e-6)


# ---- what cannot be -----------------------------------------------------------------------------------------------


def test_a_reference_without_the_lattice_is_refused_and_the_old_one_stays() -> None:
    normalise = normaliser_for_pictures(MODEL, GEL, GRID)
    render = Renderer(MODEL, GEL)
    normalise.take_reference(frame(render(flat())))
    before = normalise.reference
    with pytest.raises(NoMarkers, match=r"shows 0 dots, not a lattice of 9 x 11 dots, 1\.5 mm apart"):
        normalise.take_reference(frame(Renderer(SensorModel(), GEL)(flat())))
    other = SensorModel(markers=Markers(rows=5, columns=5, pitch=2.5e-3, radius=0.3e-3))
    with pytest.raises(NoMarkers, match=r"25 dots 2\.5 mm apart"):
        normalise.take_reference(frame(Renderer(other, GEL)(flat())))
    turned = SensorModel(markers=Markers(rows=9, columns=6))
    with pytest.raises(NoMarkers, match="shows 54 of 99 dots in view"):
        normalise.take_reference(frame(Renderer(turned, GEL)(flat())))
    assert normalise.reference is before
    flow = normalise(frame(render(dent()), 1), now=0.0).flow
    assert flow is not None
    assert np.median(np.linalg.norm(flow - marker_flow(dent(), MARKERS), axis=2)) < 2e-6


def test_more_dots_than_the_model_knows_are_refused() -> None:
    few = normaliser_for_pictures(SensorModel(markers=Markers(rows=5, columns=6)), GEL, GRID)
    with pytest.raises(NoMarkers, match="69 dots more than a lattice of 5 x 6"):
        few.take_reference(frame(Renderer(MODEL, GEL)(flat())))


def test_dots_that_no_model_knows_are_refused() -> None:
    normalise = normaliser_for_pictures(SensorModel(), GEL, GRID)
    with pytest.raises(UnusableReference, match=r"lattice of 9 x 11 dark dots, 24 px apart, but .* no markers"):
        normalise.take_reference(frame(Renderer(MODEL, GEL)(flat())))


def test_dots_that_vanish_all_at_once_are_an_error_and_not_a_flow() -> None:
    normalise = normaliser_for_pictures(MODEL, GEL, GRID)
    render = Renderer(MODEL, GEL)
    normalise.take_reference(frame(render(flat())))
    shown = render(drag((0.4e-3, 0.0)))
    normalise(frame(shown, 1), now=0.0)
    with pytest.raises(TooFewMarkers, match="0 of 99 markers are seen"):
        normalise(frame(np.zeros_like(shown), 2), now=0.0)
    assert normalise.visible_marker_share == 0.0
    normalise(frame(shown, 3), now=0.0)  # the light is on again
    assert normalise.visible_marker_share == 1.0


def test_dots_that_the_image_cannot_show_are_refused() -> None:
    coarse = SensorModel(markers=MARKERS, geometry=SensorGeometry(width=64, height=48, pixel_pitch=0.3e-3))
    with pytest.raises(ValueError, match=r"radius 0\.25 mm are 0\.83 px in the image"):
        normaliser_for_pictures(coarse, GEL, GRID)


def test_who_finds_flow_says_so() -> None:
    assert normaliser_for_pictures(MODEL, GEL, GRID).finds_flow
    assert not normaliser_for_pictures(SensorModel(), GEL, GRID).finds_flow
    plain = normaliser_for_camera(CameraSensorConfig(driver="camera", source="x"), GEL, GRID)
    assert isinstance(plain, FrameNormaliser)
    assert not plain.finds_flow
    assert plain.visible_markers is None
    assert plain.visible_marker_share == 1.0


@pytest.mark.parametrize(("radius", "pitch", "angle"), [(4.0, 24.0, 0.0), (2.5, 13.0, 0.2), (8.0, 40.0, -0.3)])
def test_the_lattice_of_an_unknown_sensor_is_measured(radius: float, pitch: float, angle: float) -> None:
    rows, columns = (4, 6) if pitch > 30 else (8, 10)
    centres = lattice_points(rows, columns, pitch, angle) + (159.5, 119.5)
    lattice, found = find_markers(draw(centres, radius, light=uneven(), noise=1.5))
    assert lattice.present.shape == (rows, columns)
    assert lattice.pitch == pytest.approx(pitch, rel=0.01)
    assert found == pytest.approx(radius, rel=0.25)
    np.testing.assert_allclose(lattice.positions, centres - (159.5, 119.5), atol=0.5)


def test_a_lamp_of_one_colour_shows_dots_too() -> None:
    grey = Lighting(background=(0.5, 0.1, 0.1))
    model = SensorModel(markers=MARKERS, lighting=grey)
    assert np.median(errors(model, STORIES["shear"], lambda image: image)) < 3e-6

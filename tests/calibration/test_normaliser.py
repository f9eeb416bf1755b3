import cv2
import numpy as np
import pytest

from calibration.frame_normaliser import FrameNormaliser, NoReference
from calibration.normaliser import normaliser_for_pictures, normaliser_for_recording, normaliser_for_simulation
from calibration.reference import UnusableReference
from tacsim.config import load_sensor
from tacsim.control import contact_signal
from tacsim.interface import SurfaceMap, TactileFrame
from tacsim.models.rig import ReplaySensorConfig
from tacsim.models.scene import GelSurface
from tacsim.models.sensor import CanonicalGrid, Markers, SensorModel
from tacsim.optics.render import Renderer
from tacsim.optics.surface import surface_map
from tests.calibration.dotted import draw, lattice_points
from tests.tacsim.optics.surfaces import dent, flat

GEL = (20e-3, 20e-3)
GRID = CanonicalGrid()
MODEL = SensorModel(markers=Markers(rows=5, columns=6))
PLAIN = SensorModel()


def _frame(image: np.ndarray, surface: SurfaceMap | None = None, time: float = 2.0) -> TactileFrame:
    return TactileFrame(image=image, time=time, index=0, surface=surface)


def _grey(level: float) -> np.ndarray:
    return np.full((240, 320, 3), level, dtype=np.uint8)


def _simulated(model: SensorModel, surface: GelSurface) -> TactileFrame:
    return _frame(Renderer(model, GEL)(surface), surface_map(surface, GRID, model.markers))


def test_the_same_frame_shows_nothing() -> None:
    normalise = normaliser_for_simulation(PLAIN, GEL, GRID)
    image = Renderer(PLAIN, GEL)(dent())
    normalise.take_reference(_frame(image))
    seen = normalise(_frame(image), now=2.5)
    assert seen.image.shape == (128, 128, 3)
    assert seen.image.dtype == np.uint8
    assert (seen.image == 128).all()
    assert not seen.contact.any()
    assert contact_signal(seen) == 0.0
    assert seen.time == 2.0
    assert seen.age == 0.5


def test_image_is_128_plus_128_times_the_relative_change() -> None:
    normalise = normaliser_for_simulation(PLAIN, GEL, GRID)
    normalise.take_reference(_frame(_grey(80)))
    seen = normalise(_frame(_grey(100)), now=2.0)
    assert (seen.image[4:124] == 128 + 32).all()
    assert (seen.image[:4] == 128).all()  # no pixels there: the image is 15 mm high
    assert contact_signal(seen) == pytest.approx(0.25)
    assert (normalise(_frame(_grey(255)), now=2.0).image[4:124] == 255).all()
    assert (normalise(_frame(_grey(30)), now=2.0).image[4:124] == 48).all()


def test_brightness_of_the_lamp_cancels() -> None:
    normalise = normaliser_for_simulation(PLAIN, GEL, GRID)
    render = Renderer(PLAIN, GEL)
    seen = []
    for gain in (1.0, 0.7):
        normalise.take_reference(_frame(np.rint(render(flat()) * gain).astype(np.uint8)))
        seen.append(normalise(_frame(np.rint(render(dent()) * gain).astype(np.uint8)), now=2.0).image.astype(int))
    assert np.abs(seen[0] - seen[1]).max() <= 2
    assert np.abs(seen[0] - 128).max() > 60


def test_contact_lies_where_the_dent_is_whether_from_height_or_from_the_image() -> None:
    normalise = normaliser_for_simulation(PLAIN, GEL, GRID)
    normalise.take_reference(_simulated(PLAIN, flat()))
    frame = _simulated(PLAIN, dent(centre=(3e-3, 2e-3)))
    known, seen = normalise(frame, now=2.0), normalise(_frame(frame.image), now=2.0)
    for observation in (known, seen):
        row, column = np.argwhere(observation.contact).mean(axis=0)
        assert column == pytest.approx(31.5 + 12, abs=1.5)
        assert row == pytest.approx(31.5 + 8, abs=1.5)
    assert (known.contact & seen.contact).sum() / seen.contact.sum() > 0.9
    np.testing.assert_array_equal(known.contact, (known.height > 20e-6) & known.valid)


def test_height_gradient_and_flow_come_from_the_source_or_are_none() -> None:
    normalise = normaliser_for_simulation(MODEL, GEL, GRID)
    normalise.take_reference(_simulated(MODEL, flat()))
    frame = _simulated(MODEL, dent(slide=(0.3e-3, 0.0)))
    seen = normalise(frame, now=2.0)
    assert frame.surface is not None
    assert seen.height is frame.surface.height
    assert seen.gradient is frame.surface.gradient
    assert seen.flow is frame.surface.flow
    blind = normalise(_frame(frame.image), now=2.0)
    assert blind.height is None
    assert blind.gradient is None
    assert blind.flow is None
    np.testing.assert_array_equal(blind.image, seen.image)


def test_contact_signal_grows_with_the_press() -> None:
    normalise = normaliser_for_simulation(PLAIN, GEL, GRID)
    normalise.take_reference(_simulated(PLAIN, flat()))
    signals = [contact_signal(normalise(_simulated(PLAIN, dent(depth=d)), 2.0)) for d in (0.0, 1e-4, 3e-4, 6e-4, 1e-3)]
    assert signals[0] == 0.0
    assert (np.diff(signals) > 0.001).all()


def test_a_camera_at_an_angle_gives_the_same_observation_as_the_simulation() -> None:
    """The rendered gel, photographed through a perspective, recorded, and brought back by its four corners."""
    corners = ((90.0, 60.0), (560.0, 110.0), (575.0, 395.0), (70.0, 440.0))
    extent = np.array([(-0.5, -0.5), (319.5, -0.5), (319.5, 239.5), (-0.5, 239.5)], dtype=np.float32)
    camera_from_image = cv2.getPerspectiveTransform(extent, np.array(corners, dtype=np.float32))
    smooth = SensorModel(texture=0.0)
    render = Renderer(smooth, GEL)
    config = ReplaySensorConfig(driver="replay", corners=corners, size=(20e-3, 15e-3))
    seen = []
    for normalise, photograph in (
        (normaliser_for_simulation(smooth, (20e-3, 15e-3), GRID), lambda image: image),
        (
            normaliser_for_recording(config, (480, 640), GRID),
            lambda image: cv2.warpPerspective(image, camera_from_image, (640, 480)),
        ),
    ):
        normalise.take_reference(_frame(photograph(render(flat()))))
        seen.append(normalise(_frame(photograph(render(dent()))), now=2.0))
    real, simulated = seen[1], seen[0]
    np.testing.assert_array_equal(real.valid, simulated.valid)
    difference = np.abs(real.image.astype(int) - simulated.image.astype(int))
    assert difference.mean() < 0.5
    assert difference.max() <= 8
    assert np.abs(simulated.image.astype(int) - 128).max() > 60
    assert contact_signal(real) == pytest.approx(contact_signal(simulated), rel=0.03)


def test_valid_cells_have_all_their_pixels() -> None:
    normalise = normaliser_for_simulation(PLAIN, (10e-3, 6e-3), GRID)
    normalise.take_reference(_frame(_grey(90)))
    valid = normalise(_frame(_grey(90)), now=2.0).valid
    assert valid.shape == (64, 64)
    assert valid.sum() == 40 * 24
    assert valid[32 - 12 : 32 + 12, 32 - 20 : 32 + 20].all()


def test_what_is_missing_or_wrong_is_said() -> None:
    normalise = normaliser_for_simulation(PLAIN, GEL, GRID)
    with pytest.raises(NoReference, match="call take_reference"):
        normalise(_frame(_grey(90)), now=2.0)
    normalise.take_reference(_frame(_grey(90)))
    with pytest.raises(UnusableReference, match="dark"):
        normalise.take_reference(_frame(_grey(0)))
    assert normalise.reference is not None
    assert normalise.reference.mean[0] == 90.0  # the old one stays
    with pytest.raises(ValueError, match=r"image is \(120, 160, 3\)"):
        normalise(_frame(np.full((120, 160, 3), 90, dtype=np.uint8)), now=2.0)
    elsewhere = surface_map(flat(), CanonicalGrid(rows=32, columns=32), None)
    with pytest.raises(ValueError, match=r"height \(32, 32\).*canonical grid is \(64, 64\)"):
        normalise(_frame(_grey(90), elsewhere), now=2.0)
    with pytest.raises(ValueError, match="canonical image has"):
        FrameNormaliser(normalise._rectify, CanonicalGrid(rows=32))


def test_glare_is_refused_where_colour_is_measured_and_not_where_dots_alone_are_followed() -> None:
    light = np.full((240, 320, 3), 110.0)
    light[:, :48] = 400.0  # 15 % of the picture; dots are dark there, too
    centres = lattice_points(7, 9, 32.0) + (160, 120)
    still, slid = (draw(centres + (shift, 0), 4.0, light=light) for shift in (0, 3))
    by_colour = ReplaySensorConfig(driver="replay")
    with pytest.raises(UnusableReference, match="saturated on 1"):
        normaliser_for_recording(by_colour, (240, 320), GRID).take_reference(_frame(still))
    by_dots = ReplaySensorConfig(driver="replay", marker_pitch=1.6e-3)
    normalise = normaliser_for_recording(by_dots, (240, 320), GRID, still)
    normalise.take_reference(TactileFrame(image=still, time=0.0, index=0))
    flow = normalise(TactileFrame(image=slid, time=0.1, index=1), now=0.1).flow
    assert flow is not None and normalise.visible_markers is not None and normalise.visible_markers.all()
    np.testing.assert_allclose(flow, np.broadcast_to((0.15e-3, 0.0), flow.shape), atol=0.01e-3)


@pytest.mark.parametrize("name", ["digit", "gelsight-mini", "gelsight-wedge", "9dtact"])
def test_pictures_of_a_shipped_sensor_give_its_height(name: str) -> None:
    """The inverse of a calibrated light is made from its forward model where there is no bundle."""
    model, surface = load_sensor(name), dent(centre=(1e-3, 0.5e-3))
    model = model.model_copy(update={"texture": 0.0})
    normalise, render = normaliser_for_pictures(model, GEL, GRID), Renderer(model, GEL)
    normalise.take_reference(_frame(render(flat())))
    found = normalise(_frame(render(surface), time=2.1), 2.1).height
    true = surface_map(surface, GRID, None).height
    assert found is not None and true is not None
    assert found.max() == pytest.approx(true.max(), rel=0.06)
    seen = true > 0.1e-3
    assert np.sqrt(np.mean((found[seen] - true[seen]) ** 2)) < 0.08 * true.max()

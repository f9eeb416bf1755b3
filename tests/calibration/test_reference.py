"""The reference image, and the drift of the light since."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from calibration.frame_normaliser import FrameNormaliser
from calibration.height.slopes import normal_of_slope
from calibration.light.fit import normal_angle
from calibration.normaliser import (
    normaliser_for_calibration,
    normaliser_for_camera,
    normaliser_for_pictures,
    normaliser_for_simulation,
)
from calibration.reference import (
    PIXEL_STRIDE,
    Drift,
    DriftFinder,
    StaleReference,
    UnusableReference,
    is_channel_order_swapped,
    make_reference,
)
from calibration.tuning import MAX_COLOUR_CHANGE, MAX_SLOPE_CHANGE, STALE_SLOPE
from tacsim.interface import TactileFrame, TactileObservation
from tacsim.models.hardware import CameraSensorConfig
from tacsim.models.sensor import CanonicalGrid, SensorModel
from tacsim.optics.render import Renderer
from tacsim.optics.surface import surface_map
from tests.calibration.presses import COLUMNS, PITCH, ROWS, HiddenSensor, Made
from tests.calibration.sources import calibrated
from tests.tacsim.optics.surfaces import dent, flat

VALID = np.ones((20, 30), dtype=bool)


def _grey(level: float) -> np.ndarray:
    return np.full((20, 30, 3), level, dtype=np.float32)


def test_difference_is_relative_to_the_mean_of_each_channel_over_the_gel() -> None:
    valid = VALID.copy()
    valid[:, 20:] = False
    image = _grey(0.0)
    image[:, :20] = (50.0, 100.0, 200.0)
    image[:10, :20] *= 0.5  # the mean over the gel is 3/4 of the bright half
    reference = make_reference(image, valid)
    np.testing.assert_allclose(reference.mean, (37.5, 75.0, 150.0))
    change = reference.difference(image + 15.0)
    np.testing.assert_allclose(change[:, :20], np.broadcast_to((0.4, 0.2, 0.1), (20, 20, 3)), rtol=1e-5)
    assert not change[:, 20:].any()


def test_unusable_references_are_refused() -> None:
    with pytest.raises(UnusableReference, match=r"is dark: mean R, G, B over the gel 3.0, 3.0, 3.0, at least 8"):
        make_reference(_grey(3.0), VALID)
    one_light_out = _grey(100.0)
    one_light_out[..., 2] = 1.0
    with pytest.raises(UnusableReference, match="is dark"):
        make_reference(one_light_out, VALID)
    glare = _grey(100.0)
    glare[:3, :, 0] = 255.0
    with pytest.raises(UnusableReference, match=r"saturated on 15\.0% of the gel, at most 5%"):
        make_reference(glare, VALID)
    make_reference(glare, VALID, colour=False)
    make_reference(glare, np.pad(VALID[3:], ((3, 0), (0, 0))))  # glare beside the gel does no harm
    with pytest.raises(UnusableReference, match="shows no gel"):
        make_reference(_grey(100.0), ~VALID)
    with pytest.raises(UnusableReference, match=r"reference is \(20, 30, 3\), expected \(10, 30, 3\)"):
        make_reference(_grey(100.0), VALID[:10])


def test_an_image_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match="take a fresh reference"):
        make_reference(_grey(100.0), VALID).difference(_grey(100.0)[:10])


GRID = CanonicalGrid()
CHANGES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "gain": lambda image: 0.7 * image,
    "white balance": lambda image: image * (1.2, 1.0, 0.85),
    "offset": lambda image: image + 25.0,
}


def frame(image: np.ndarray, surface: object = None) -> TactileFrame:
    return TactileFrame(np.clip(np.rint(image), 0, 255).astype(np.uint8), time=0.0, index=0, surface=surface)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def sensor() -> HiddenSensor:
    return HiddenSensor(3)


@pytest.fixture(scope="module")
def bundle(sensor: HiddenSensor):
    return calibrated(sensor)


@pytest.fixture
def normalise(bundle) -> FrameNormaliser:
    return normaliser_for_calibration(bundle[0], GRID, bundle[1])


def angle(seen: TactileObservation, press: Made) -> float:
    """Mean error of the normal in contact [degrees]."""
    at = (np.arange(64) - 31.5) * GRID.pitch / PITCH
    u, v = np.meshgrid(at + (COLUMNS - 1) / 2, at + (ROWS - 1) / 2)
    true = press.gradient[np.rint(v).clip(0, ROWS - 1).astype(int), np.rint(u).clip(0, COLUMNS - 1).astype(int)]
    inside = seen.valid & (np.hypot(u - press.circle[0], v - press.circle[1]) < press.circle[2])
    assert seen.gradient is not None
    return float(normal_angle(normal_of_slope(seen.gradient.astype(float)), normal_of_slope(true))[inside].mean())


@pytest.mark.slow
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_stale_reference_is_seen_in_contact_and_without(
    change, normalise: FrameNormaliser, sensor: HiddenSensor, bundle
) -> None:
    press = sensor.press(0.5e-3, 130, 100)
    for image in (sensor.empty(), press.image):
        normalise.take_reference(frame(bundle[1]))
        normalise(frame(image), 0.0)
        assert not normalise.stale and normalise.drift_slope < 0.6
        assert normalise.diagnostics()["stale"] == 0.0
        normalise(frame(change(image.astype(float))), 0.0)
        assert normalise.stale and normalise.drift_slope > STALE_SLOPE
        told = normalise.diagnostics()
        assert told["stale"] == 1.0 and told["background"] == normalise.drift_slope
        normalise.take_reference(frame(change(sensor.empty().astype(float))))  # a fresh one
        normalise(frame(change(image.astype(float))), 0.0)
        assert not normalise.stale and normalise.drift_slope < 0.6


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_with_the_drift_removed_a_stale_reference_costs_little(
    change, normalise: FrameNormaliser, sensor: HiddenSensor, bundle
) -> None:
    """17 to 21 degrees where nothing is removed."""
    press = sensor.press(0.5e-3, 130, 100)
    normalise.take_reference(frame(bundle[1]))
    assert angle(normalise(frame(press.image), 0.0), press) < 1.5
    assert angle(normalise(frame(change(press.image.astype(float))), 0.0), press) < 6.0


def test_a_reference_becomes_stale_by_and_by(normalise: FrameNormaliser, sensor: HiddenSensor, bundle) -> None:
    press = sensor.press(0.5e-3, 130, 100)
    normalise.take_reference(frame(bundle[1]))
    told: list[tuple[float, float, bool]] = []
    for gain in (1.0, 0.98, 0.95, 0.9, 0.8, 0.7):
        normalise(frame(gain * press.image.astype(float)), 0.0)
        told.append((normalise.drift_slope, normalise.drift, normalise.stale))
    assert np.all(np.diff([background for background, _, _ in told]) > 0)
    assert [drift for _, drift, _ in told] == pytest.approx([0.0, 0.02, 0.05, 0.1, 0.2, 0.3], abs=0.01)
    assert not told[1][2] and told[3][2]  # before it costs a degree, and after


@pytest.mark.parametrize(
    "change", [lambda image: image * (0.1, 1, 1), lambda image: 0.05 * image], ids=["a lamp out", "all lamps out"]
)
def test_nothing_is_told_by_another_light(change, normalise: FrameNormaliser, sensor: HiddenSensor, bundle) -> None:
    normalise.take_reference(frame(bundle[1]))
    with pytest.raises(StaleReference, match=r"Is a lamp out.*take a fresh reference"):
        normalise(frame(change(sensor.press(0.5e-3, 130, 100).image.astype(float))), 0.0)
    assert normalise.drift_slope > MAX_SLOPE_CHANGE or normalise.drift > MAX_COLOUR_CHANGE


def test_a_lamp_that_tilts_nothing_is_told_by_the_colour() -> None:
    """Three lights alike: dimmed together they leave the background flat, and heights too low."""
    model = SensorModel()
    normalise = normaliser_for_pictures(model, (20e-3, 20e-3), GRID)
    render = Renderer(model, (20e-3, 20e-3))
    normalise.take_reference(frame(render(flat())))
    deep = normalise(frame(render(dent())), 0.0).height.max()
    assert normalise(frame(0.8 * render(dent()).astype(float)), 0.0).height.max() < 0.9 * deep
    assert normalise.drift_slope < STALE_SLOPE and normalise.stale


def test_where_too_little_is_untouched_the_last_word_stays(
    normalise: FrameNormaliser, sensor: HiddenSensor, bundle
) -> None:
    normalise.take_reference(frame(bundle[1]))
    assert normalise.drift_slope is None and not normalise.stale and normalise.diagnostics() == {}
    normalise(frame(0.8 * bundle[1].astype(float)), 0.0)
    before = normalise.drift_slope
    checks = 40.0 * (-1) ** np.add.outer(np.arange(ROWS) // 20, np.arange(COLUMNS) // 20)[..., None]
    normalise(frame(bundle[1] + checks), 0.0)  # pressed all over
    assert normalise.drift_slope == before and normalise.stale


def test_a_large_contact_is_no_drift_and_a_simulation_has_none() -> None:
    model = SensorModel()
    normalise = normaliser_for_pictures(model, (20e-3, 20e-3), GRID)
    render = Renderer(model, (20e-3, 20e-3))
    normalise.take_reference(frame(render(flat())))
    normalise(frame(render(dent(depth=1e-3))), 0.0)
    assert normalise.drift_slope < 0.5 and not normalise.stale
    known = normaliser_for_simulation(model, (20e-3, 20e-3), GRID)
    known.take_reference(frame(render(flat())))
    known(frame(0.7 * render(flat()).astype(float), surface_map(flat(), GRID, None)), 0.0)
    assert known.diagnostics() == {} and not known.stale


def test_a_sensor_without_slopes_is_watched_by_its_colour() -> None:
    corners = ((0.0, 0.0), (319.0, 0.0), (319.0, 239.0), (0.0, 239.0))
    config = CameraSensorConfig(driver="camera", source="x", corners=corners, width=320, height=240)
    normalise = normaliser_for_camera(config, (1.0, 1.0), GRID)
    image = Renderer(SensorModel(), (20e-3, 20e-3))(dent()).astype(float)
    normalise.take_reference(frame(Renderer(SensorModel(), (20e-3, 20e-3))(flat())))
    normalise(frame(image), 0.0)
    assert normalise.diagnostics() == {"stale": 0.0, "drift": pytest.approx(0.0, abs=0.02)}
    normalise(frame(0.9 * image), 0.0)
    assert normalise.diagnostics() == {"stale": 1.0, "drift": pytest.approx(0.1, abs=0.02)}
    with pytest.raises(StaleReference, match="of its colour"):
        normalise(frame(0.3 * image), 0.0)


def test_swapped_colours_are_told_by_the_calibrations_own_picture(
    normalise: FrameNormaliser, sensor: HiddenSensor, bundle
) -> None:
    for change in CHANGES.values():  # no drift looks like it
        normalise.take_reference(frame(change(sensor.empty().astype(float))))
    with pytest.raises(UnusableReference, match="red and blue are exchanged"):
        normalise.take_reference(frame(sensor.empty()[..., ::-1]))
    even = np.full((80, 80, 3), (90.0, 100.0, 110.0), dtype=np.float32)
    assert not is_channel_order_swapped(
        even[..., ::-1], even, np.ones((80, 80), dtype=np.bool_)
    )  # nothing tells them apart
    assert not is_channel_order_swapped(
        even[:4, :4, ::-1], even[:4, :4], np.ones((4, 4), dtype=np.bool_)
    )  # smaller than a block


def test_the_drift_is_a_quadratic_through_what_is_calm() -> None:
    v, u = np.mgrid[-1:1:120j, -1:1:160j].astype(np.float32)
    true = np.stack([0.03 + 0.05 * u, 0.02 * v * v - 0.01, -0.04 * u * v])
    touched = np.hypot(u, v) < 0.4
    planes = (true + np.where(touched, 0.5, 0.0)).astype(np.float32)
    planes[:, :20] = 9.0  # hidden
    hidden = np.zeros((120, 160), dtype=np.bool_)
    hidden[:20] = True
    finder = DriftFinder((120, 160))
    drift = finder(planes, hidden)
    assert drift.measured
    np.testing.assert_allclose(
        finder.drift_at_stride(drift), true[:, ::PIXEL_STRIDE, ::PIXEL_STRIDE].reshape(3, -1).T, atol=2e-4
    )
    finder.remove(planes, drift)
    assert np.abs(planes[:, ~hidden & ~touched]).max() < 2e-4
    assert not finder(planes, np.ones_like(hidden)).measured


def _smooth_drift(rows: int, columns: int) -> np.ndarray:
    """(rows, columns, 3) grey levels by which a lamp that warms up changes the picture: smooth, and no quadratic."""
    v, u = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : columns * 1j]
    return np.stack([7 * np.cos(1.2 * u - 0.5), 5 * u - 3 * np.sin(v), -6 * np.exp(-((u - v) ** 2) / 3)], axis=-1)


def test_the_drift_is_taken_off_the_canonical_image_and_the_contact_stays(
    normalise: FrameNormaliser, sensor: HiddenSensor, bundle
) -> None:
    empty, press = sensor.empty(), sensor.press(0.5e-3, 130, 100).image
    drift = _smooth_drift(ROWS, COLUMNS)
    normalise.take_reference(frame(empty))
    with_drift, without = (normalise(frame(press + d), 0.0).image.astype(int) for d in (drift, 0.0))
    # the frame itself, 128 + 128 (I - I0) / mean(I0), pixel by pixel of its middle
    assert normalise.reference is not None
    raw, drifted = (
        128 + 128 * _middle(normalise._rectify(image.astype(np.uint8)) - normalise.reference.image)
        / normalise.reference.mean
        for image in (press, np.rint(press + drift))
    )  # fmt: skip
    assert np.abs(drifted - raw).mean() > 4.0  # what the policy would see of it
    for seen in (with_drift, without):
        assert np.abs(seen - raw).mean() < 0.8
        assert np.abs(seen - raw).max() < 4.0
    contact = np.abs(raw - 128).max(axis=2) > 20
    assert contact.sum() > 250
    assert np.abs((with_drift - raw)[contact]).mean() < 1.0  # of a signal of more than 20


def _middle(view: np.ndarray) -> np.ndarray:
    top, left = (view.shape[0] - 128) // 2, (view.shape[1] - 128) // 2
    return view[top : top + 128, left : left + 128]


def test_the_drift_is_taken_off_where_no_slopes_are_known_too() -> None:
    """A gel that does not fill the canonical image: what is not seen stays without change."""
    corners = ((0.0, 0.0), (319.0, 0.0), (319.0, 239.0), (0.0, 239.0))
    config = CameraSensorConfig(
        driver="camera", source="x", corners=corners, size=(20e-3, 15e-3), width=320, height=240
    )  # fmt: skip
    normalise = normaliser_for_camera(config, (1.0, 1.0), GRID)
    render = Renderer(SensorModel(texture=0.0), (20e-3, 15e-3))
    normalise.take_reference(frame(render(flat())))
    plain = normalise(frame(render(dent())), 0.0)
    drifted = normalise(frame(render(dent()) + _smooth_drift(240, 320)), 0.0)
    assert (drifted.image[:3] == 128).all() and (drifted.image[-3:] == 128).all()
    difference = np.abs(drifted.image.astype(int) - plain.image.astype(int))
    assert difference.mean() < 0.8 and difference.max() < 5
    assert (drifted.contact == plain.contact).mean() > 0.99


def test_a_simulated_image_is_what_it_was_to_the_last_bit(sensor: HiddenSensor, bundle) -> None:
    """Neither a simulation that knows its surface, nor its pictures alone, nor its frames behind a real normaliser."""
    model = SensorModel()
    render = Renderer(model, (20e-3, 20e-3))
    changed = 0.95 * render(dent()).astype(float)  # a drift that would be told
    for make in (normaliser_for_simulation, normaliser_for_pictures):
        for surface in (surface_map(dent(), GRID, None), None):
            normalise = make(model, (20e-3, 20e-3), GRID)
            normalise.take_reference(frame(render(flat())))
            seen = normalise(frame(changed, surface), 0.0)
            np.testing.assert_array_equal(seen.image, _untreated(normalise, frame(changed)))
    real = normaliser_for_calibration(bundle[0], GRID, bundle[1])
    real.take_reference(frame(bundle[1]))
    bright = frame(sensor.press(0.5e-3, 130, 100).image + 10.0, surface_map(dent(), GRID, None))
    np.testing.assert_array_equal(real(bright, 0.0).image, _untreated(real, bright))
    alone = TactileFrame(bright.image, time=0.0, index=0)
    assert (real(alone, 0.0).image != _untreated(real, alone)).any()


def _untreated(normalise: FrameNormaliser, seen: TactileFrame) -> np.ndarray:
    assert normalise.reference is not None
    change = _middle(normalise.reference.difference(normalise._rectify(seen.image)))
    return np.clip(np.rint(128 + np.float32(128) * change), 0, 255).astype(np.uint8)


def test_where_too_little_is_untouched_the_image_keeps_its_drift(normalise: FrameNormaliser, bundle) -> None:
    checks = 40.0 * (-1) ** np.add.outer(np.arange(ROWS) // 20, np.arange(COLUMNS) // 20)[..., None]
    normalise.take_reference(frame(bundle[1]))
    pressed = frame(bundle[1] + checks + 10.0)
    np.testing.assert_array_equal(normalise(pressed, 0.0).image, _untreated(normalise, pressed))


def test_a_part_of_a_view_has_the_drift_of_the_whole() -> None:
    planes = np.zeros((3, 120, 160), dtype=np.float32)
    weights = np.random.default_rng(0).normal(0, 0.1, (6, 3)).astype(np.float32)
    finder, drift = DriftFinder((120, 160)), Drift(weights, measured=True)
    finder.remove(planes, drift)
    np.testing.assert_allclose(finder.drift_on_part(drift, (0, 0), (120, 160)), -np.moveaxis(planes, 0, -1), atol=1e-6)
    np.testing.assert_allclose(
        finder.drift_on_part(drift, (11, 23), (60, 70)), -np.moveaxis(planes, 0, -1)[11:71, 23:93], atol=1e-6
    )
    np.testing.assert_allclose(
        finder.drift_on_part(drift, (-4, -6), (120, 160))[4:, 6:], -np.moveaxis(planes, 0, -1)[:116, :154], atol=1e-6
    )

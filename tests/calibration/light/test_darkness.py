"""Lights that tell no direction: what darkness tells of depth, on made-up pictures whose true surface is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from calibration.bundle import read_bundle, read_sensor_model, write_bundle
from calibration.height.slopes import DarknessSlopes
from calibration.light.calibrator import NoDirection, calibrate_light
from calibration.light.darkness import dark_circle, is_direction_free
from calibration.light.dent import NoCircle
from calibration.light.fit import LightFit
from calibration.light.verdict import KnownScale, evaluate_calibration, write_page
from calibration.normaliser import normaliser_for_calibration, normaliser_for_pictures
from robot.cli import app
from tacsim.interface import TactileFrame
from tacsim.models.sensor import CanonicalGrid
from tacsim.optics.grid import canonical_cells
from tacsim.optics.render import Renderer
from tacsim.optics.surface import sample_surface
from tests.calibration.presses import BALL, BALL_PX, COLUMNS, PITCH, ROWS, DarkSensor, HiddenSensor, Made
from tests.tacsim.optics.surfaces import dent, flat


class RingSensor(DarkSensor):
    """Dark on steep flanks, all alike, and bright where the surface is flat: depth is not told."""

    def press(self, depth: float, x: float, y: float, drift: np.ndarray | float = 0.0, ball: float = BALL_PX) -> Made:
        made = HiddenSensor.press(self, depth, x, y, drift, ball)
        return replace(made, image=self.seen(0.5 * np.minimum(np.hypot(*np.moveaxis(made.gradient, -1, 0)), 1) ** 2))


def calibrated(sensor: HiddenSensor, count: int) -> tuple[LightFit, list[Made]]:
    presses = sensor.presses(count)
    return calibrate_light(sensor.empty(), [(f"{i}", press.image) for i, press in enumerate(presses)], BALL_PX), presses


def height_error(fit: LightFit, sensor: DarkSensor, unseen: Made) -> float:
    """Root mean square in contact and near it, over the depth."""
    assert fit.darkness is not None
    change = (unseen.image.astype(np.float32) - fit.reference) / fit.reference.mean(axis=(0, 1), dtype=np.float32)
    found, _ = DarknessSlopes(fit.darkness.scaled(PITCH), (ROWS, COLUMNS), PITCH).depth(change)
    x, y, radius = unseen.circle
    v, u = np.mgrid[:ROWS, :COLUMNS]
    near = np.hypot(u - x, v - y) < 1.5 * radius
    off = PITCH * found[near] - unseen.height[near]
    return float(np.sqrt(((off - off.mean()) ** 2).mean()) / unseen.height.max())


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.4])
def test_heights_of_an_unseen_press_come_back(share: float) -> None:
    sensor = DarkSensor(1, share)
    fit, presses = calibrated(sensor, 4)
    assert fit.forward is None and fit.inverse is None and not fit.left_out
    for found, true in zip(fit.presses, presses, strict=True):
        assert np.hypot(found.circle.x - true.circle[0], found.circle.y - true.circle[1]) < 0.5
        assert found.circle.radius == pytest.approx(true.circle[2], rel=0.06)
    assert height_error(fit, sensor, sensor.press(0.45e-3, 120, 110)) < 0.04
    assert all(prediction.correlation > 0.98 for prediction in fit.predictions)
    shallower = sorted(fit.predictions, key=lambda prediction: prediction.circle.radius)[:-1]
    assert all(prediction.angle < 4 for prediction in shallower)  # the deepest reaches beyond the others' table
    assert evaluate_calibration(fit, KnownScale(PITCH, BALL)).word == "unverified scale"  # nothing checks the lengths
    verdict = evaluate_calibration(fit, KnownScale(PITCH, BALL, depths=(("0", 0.5e-3),)))
    assert verdict.word == "usable" and "4 presses could be used" in str(verdict)


def test_one_press_gives_the_table_and_is_said_to_be_one(tmp_path: Path) -> None:
    sensor = DarkSensor(2, 0.4)
    press = sensor.press(0.65e-3, 130, 100)
    fit = calibrate_light(sensor.empty(), [("one", press.image)], BALL_PX)
    assert height_error(fit, sensor, sensor.press(0.4e-3, 90, 80)) < 0.06
    assert evaluate_calibration(fit, KnownScale(PITCH, BALL)).word == "unverified scale"
    scale = KnownScale(PITCH, BALL, depths=(("one", 0.65e-3),))
    verdict = evaluate_calibration(fit, scale)
    assert verdict.word == "usable" and "1 press could be used: that gives the table" in str(verdict)
    write_page(tmp_path / "page.html", "dark", fit, scale, verdict, None, [])
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "darkness that no depth explains" in page and "fewer than 3" not in page


def test_the_pictures_tell_which_light_it_is() -> None:
    for sensor, alike in ((HiddenSensor(3), False), (DarkSensor(3), True), (DarkSensor(3, 0.4), True)):
        reference = sensor.empty().astype(float)
        assert is_direction_free((p.image - reference) / 100 for p in sensor.presses(4)) is alike


def test_one_lamp_brighter_than_the_others_still_tells_direction() -> None:
    """The strongest change is then one flank's, a patch that is round by itself."""
    for seed in (3, 4, 5):
        sensor = HiddenSensor(seed, noise=0.5)
        reference = sensor.empty().astype(float)
        changes = [(press.image - reference) / 100 * (6.0, 1.0, 1.0) for press in sensor.presses(5)]
        assert not is_direction_free(np.maximum(change, -0.05) for change in changes)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.4])
def test_a_contact_is_found_by_its_darkness(share: float) -> None:
    sensor = DarkSensor(6, share)
    for depth in (0.35e-3, 0.65e-3):
        x, y, radius = sensor.press(depth, 120, 90).circle
        found = dark_circle(sensor.press(depth, 120, 90).image, sensor.empty(), BALL_PX)
        assert np.hypot(found.x - x, found.y - y) < 0.5
        assert found.radius == pytest.approx(radius, rel=0.08)
        assert found.explained_share > 0.95


def test_no_contact_is_found_in_what_darkness_does_not_tell() -> None:
    sensor = DarkSensor(6)
    with pytest.raises(NoCircle, match="no ball's contact is seen: colours change by"):
        dark_circle(sensor.empty(), sensor.empty(), BALL_PX)
    bar = sensor.empty()
    bar[95:105, 60:200] //= 2
    with pytest.raises(NoCircle, match=r"no ball's contact is seen: the depth of a dent explains .* 90% are needed"):
        dark_circle(bar, sensor.empty(), BALL_PX)
    twice = np.minimum(sensor.press(0.5e-3, 60, 60).image, sensor.press(0.5e-3, 200, 140).image)
    with pytest.raises(NoCircle, match="a second contact"):
        dark_circle(twice, sensor.empty(), BALL_PX)


@pytest.mark.slow
def test_flanks_that_are_dark_all_alike_tell_no_depth() -> None:
    with pytest.raises(NoDirection, match="this light tells no direction"):
        calibrated(RingSensor(4), 3)


def test_a_frame_without_contact_is_left_out() -> None:
    sensor = DarkSensor(4)
    frames = [("press", sensor.press(0.5e-3, 130, 100).image), ("nothing", sensor.empty())]
    assert [name for name, _ in calibrate_light(sensor.empty(), frames, BALL_PX).left_out] == ["nothing"]


@pytest.mark.slow
def test_a_bundle_rendered_and_found_again_gives_the_same_heights(tmp_path: Path) -> None:
    fit, _ = calibrated(DarkSensor(5, 0.4), 4)
    write_bundle(tmp_path, fit.to_calibration("dark", BALL, PITCH), fit.reference)
    calibration, reference = read_bundle(tmp_path)
    assert calibration.darkness is not None and calibration.forward is None
    model, grid = read_sensor_model(tmp_path), CanonicalGrid()
    render = Renderer(model, (COLUMNS * PITCH, ROWS * PITCH))
    np.testing.assert_array_equal(render(flat()), reference)
    picture = render(dent())
    true = sample_surface(dent(), canonical_cells(grid))
    for normalise in (
        normaliser_for_calibration(calibration, grid, reference),
        normaliser_for_pictures(model, (COLUMNS * PITCH, ROWS * PITCH), grid),
    ):
        normalise.take_reference(TactileFrame(reference, time=0.0, index=0))
        seen = normalise(TactileFrame(picture, time=0.1, index=1), now=0.2)
        assert seen.height is not None and seen.gradient is not None
        off = (seen.height - true.height)[seen.valid]
        assert np.sqrt((off**2).mean()) < 0.03 * true.height.max()
        assert np.sqrt(((seen.gradient - true.gradient)[seen.valid] ** 2).mean()) < 0.05


def run(folder: Path, sensor: DarkSensor, *words: str) -> tuple[int, str]:
    frames = folder / "frames"
    frames.mkdir()
    Image.fromarray(sensor.empty()).save(frames / "background.png")
    for number, press in enumerate(sensor.presses(2)):
        Image.fromarray(press.image).save(frames / f"{number}.png")
    lengths = ["--ball-diameter", f"{2e3 * BALL} mm", "--pixel-pitch", f"{1e3 * PITCH} mm"]
    done = CliRunner().invoke(app, ["calibrate", "sensor", str(frames), *lengths, *words, "--out", str(folder / "out")])
    return done.exit_code, " ".join(done.output.split())


@pytest.mark.slow
def test_the_command_says_which_light_it_found_and_what_was_expected(tmp_path: Path) -> None:
    code, output = run(tmp_path, DarkSensor(7, 0.4), "--kind", "digit", "--serial", "finger")
    assert code in (0, 3) and "this light does not depend on the direction of slopes: darkness gives depth" in output
    assert "is --kind right?" in output
    assert read_bundle(tmp_path / "out")[0].darkness is not None
    page = (tmp_path / "out" / "verdict.html").read_text(encoding="utf-8")
    assert "<title>finger, DIGIT: " in page and "darkness tells depth" in page


@pytest.mark.slow
def test_no_bundle_is_written_where_nothing_is_told(tmp_path: Path) -> None:
    code, output = run(tmp_path, RingSensor(8))
    assert code == 3 and "this light tells no direction" in output and "no bundle is written" in output
    assert not (tmp_path / "out" / "calibration.yaml").exists()

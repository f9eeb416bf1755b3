"""`tacsim calibrate sensor` on folders of pictures: bundle, verdict, what is refused and what is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from calibration.bundle import read_bundle, read_sensor_model
from calibration.normaliser import normaliser_for_calibration
from tacsim.interface import SensorSpec, TactileFrame
from tacsim.models.sensor import CanonicalGrid
from tacsim.optics.noise import noise_source
from tacsim.optics.render import Renderer
from tacsim.sim.sensor import SimSensor
from tests.calibration.dotted import draw, lattice_points
from tests.calibration.presses import BALL, COLUMNS, PITCH, ROWS, HiddenSensor
from tests.calibration.sources import save_picture, write_presses
from tests.robot.cli.invoked import plain_text, tacsim
from tests.tacsim.optics.surfaces import flat

SIZE = f"{COLUMNS * PITCH * 1e3} mm, {ROWS * PITCH * 1e3} mm"  # of the gel that the pictures show


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_presses(tmp_path / "frames")


@pytest.mark.slow
def test_calibrate_sensor_writes_bundle_and_image(folder: Path, tmp_path: Path) -> None:
    lengths = ["--ball-radius", f"{BALL * 1e3} mm", "--pixel-pitch", f"{PITCH * 1e3} mm"]
    out = tmp_path / "out"
    ran = tacsim("calibrate", "sensor", folder, *lengths, "--serial", "s1", "--out", out)
    assert ran.exit_code == 4, ran.output
    calibration, _ = read_bundle(out, "s1")
    assert len(calibration.residuals) == 5
    assert calibration.geometry.pixel_pitch == pytest.approx(PITCH)
    assert (out / "residuals.png").stat().st_size > 10_000
    assert "press_3.png" in ran.output
    assert calibration.noise is not None and "noise, from around the contacts: R, G, B" in ran.output
    assert "nothing checks the lengths" in ran.stderr and "verdict: unverified scale" in ran.output
    known = ("--size", SIZE, "--depth", "press_2.png=0.65 mm")
    sure = tacsim("calibrate", "sensor", folder, *lengths, *known, "--out", tmp_path / "sure")
    assert sure.exit_code == 0 and "verdict: good" in sure.output and "nothing checks the lengths" not in sure.stderr, (
        sure.output
    )
    again = tacsim("calibrate", "sensor", folder, *lengths, "--out", out)
    assert again.exit_code == 2
    assert "overwritten" in again.output
    nothing = tacsim("calibrate", "sensor", tmp_path / "none", *lengths, "--out", str(out) + "2")
    assert nothing.exit_code == 2
    assert "folder" in nothing.output
    assert "Traceback" not in nothing.output


@pytest.mark.slow
def test_calibrate_sensor_keeps_folder_made_by_other_process(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two at once into one folder: the second writes nothing."""
    from calibration.light import calibrator

    out, calibrate = tmp_path / "out", calibrator.calibrate_light

    def somebody_is_faster(*given: object) -> object:
        out.mkdir()
        (out / "calibration.yaml").write_text("another's", encoding="utf-8")
        return calibrate(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(calibrator, "calibrate_light", somebody_is_faster)
    lengths = ["--ball-radius", f"{BALL * 1e3} mm", "--pixel-pitch", f"{PITCH * 1e3} mm"]
    ran = tacsim("calibrate", "sensor", folder, *lengths, "--out", out)
    assert ran.exit_code == 2 and "exists already; nothing is overwritten" in ran.output
    assert [path.name for path in out.iterdir()] == ["calibration.yaml"]
    assert (out / "calibration.yaml").read_text(encoding="utf-8") == "another's"


@pytest.mark.slow
def test_calibrate_sensor_grey_images_are_reported(folder: Path, tmp_path: Path) -> None:
    """Of coloured light they keep too little: neither direction nor depth."""
    for path in folder.glob("*.png"):
        save_picture(path, np.repeat(np.asarray(Image.open(path).convert("L"))[..., None], 3, axis=2))
    lengths = ["--ball-radius", f"{BALL * 1e3} mm", "--pixel-pitch", f"{PITCH * 1e3} mm"]
    ran = tacsim("calibrate", "sensor", folder, *lengths, "--out", tmp_path / "out")
    assert ran.exit_code == 3 and "the pictures are grey" in ran.output


@pytest.mark.slow
def test_calibrate_sensor_prints_verdict(folder: Path, tmp_path: Path) -> None:
    """Two presses are not enough: the exit code is 3, the bundle and the page say why."""
    for number in (2, 3, 4):
        (folder / f"press_{number}.png").unlink()
    lengths = ["--ball-diameter", f"{2e3 * BALL} mm", "--kind", "digit", "--pixel-pitch", f"{PITCH * 1e3} mm"]
    ran = tacsim("calibrate", "sensor", folder, *lengths, "--out", tmp_path / "out")
    assert ran.exit_code == 3, ran.output
    assert "verdict: do not trust" in ran.output and "press five at least" in ran.output
    assert "11.4 x 15.2 mm of the gel" in ran.output  # a DIGIT's picture shows less
    calibration, _ = read_bundle(tmp_path / "out")
    assert calibration.serial == "out"  # its folder's name, where nobody gave one
    assert calibration.provenance.ball_radius == pytest.approx(BALL)
    assert calibration.provenance.warnings[0].startswith("verdict: do not trust")
    assert "do not trust" in (tmp_path / "out" / "verdict.html").read_text(encoding="utf-8")
    ran = tacsim("calibrate", "sensor", folder, *lengths[:4], "--out", tmp_path / "published")  # its pitch is DIGIT's
    assert "nothing checks it on yours" in ran.output and "mm of the gel" in ran.output


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--ball-radius", "2.92", "--pixel-pitch", "0.06 mm"), "'2.92' has no unit; say '2.92 mm'"),
        (("--ball-radius", "2.92 mm", "--pixel-pitch", "6e-5"), "has no unit"),
        (("--ball-radius", "2.92 m", "--pixel-pitch", "0.06 mm"), "allowed"),
        (("--ball-radius", "3 mm", "--ball-diameter", "6 mm", "--pixel-pitch", "0.06 mm"), "not both"),
        (("--ball-radius", "nan", "--pixel-pitch", "0.06 mm"), "allowed: a number with its unit"),
        (("--ball-diameter", "6 mm", "--kind", "minni"), "known: mini,"),
        (("--ball-diameter", "6 mm", "--pixel-pitch", "0.06 mm", "--size", "20 mm, 0 mm"), "above 0"),
        (("--ball-diameter", "6 mm", "--kind", "other"), "--pixel-pitch or --view"),
        (("--ball-diameter", "6 mm", "--pixel-pitch", "0.06 mm", "--depth", "press_9.png=1 mm"), "press_0.png"),
        (("--ball-diameter", "6 mm", "--pixel-pitch", "0.06 mm", "--depth", "press_1.png=1"), "say '1 mm'"),
        (("--ball-diameter", "6 mm", "--pixel-pitch", "0.06 mm", "--serial", "my finger"), "'my finger' is no serial"),
        (("--ball-diameter", "6 mm", "--pixel-pitch", "0.06 mm", "--region", "9,9 900,9 9,90"), "900,9"),
        (("--ball-diameter", "6 mm", "--pixel-pitch", "0.06 mm", "--marker-pitch", "1 mm"), "give --markers, too"),
        (
            ("--ball-diameter", "6 mm", "--pixel-pitch", "0.06 mm", "--set", "foo.bar=1"),
            "it changes the rig of a camera",
        ),
    ],
)
def test_calibrate_sensor_ambiguous_options_are_refused(folder: Path, words: tuple[str, ...], said: str) -> None:
    ran = tacsim("calibrate", "sensor", folder, *words, COLUMNS="300")
    assert ran.exit_code == 2
    assert said in ran.output


def test_calibrate_sensor_camera_with_reference_is_refused() -> None:
    words = ("--camera", "http://127.0.0.1:9/", "--reference", "free.png", "--ball-diameter", "6 mm", "--kind", "mini")
    ran = tacsim("calibrate", "sensor", *words, COLUMNS="300")
    assert ran.exit_code == 2 and "taken first" in ran.output


@pytest.mark.slow
def test_calibrate_sensor_measures_camera_noise(folder: Path, tmp_path: Path) -> None:
    again = HiddenSensor(2)  # the same untouched gel, whose light drifts
    for number in (1, 2, 3):
        image = again.photograph(np.zeros((200, 260, 2)), drift=2.0 * number)
        save_picture(folder / f"background_{number}.png", image)
    words = ["calibrate", "sensor", str(folder), "--ball-radius", f"{BALL} m", "--pixel-pitch", f"{PITCH} m"]
    ran = tacsim(*words, "--size", SIZE, "--out", tmp_path / "out")
    assert ran.exit_code == 0, ran.output
    assert "camera's noise, from 4 pictures without contact: R, G, B 1.5" in ran.output
    noise = read_bundle(tmp_path / "out")[0].noise
    assert noise is not None and noise.deviation == pytest.approx((1.53, 1.53, 1.53), rel=0.03)
    assert noise.neighbours == pytest.approx((0, 0), abs=0.03) and noise.colours == pytest.approx((0, 0, 0), abs=0.03)

    # the twin delivers it: another in each frame and episode, the same in the same ones
    class Still:
        version = 0

        def now(self) -> float:
            return 0.0

        def diagnostics(self) -> dict[str, float]:
            return {}

        def surface(self, frame: str) -> object:
            return flat()

    model, world = read_sensor_model(tmp_path / "out"), Still()
    spec = SensorSpec((model.geometry.height, model.geometry.width), height=False, flow=False, arm=None)
    render = Renderer(model, (40e-3, 40e-3))
    sensor = SimSensor(world, world, "s", spec, render, lambda at: None, noise_source(model, "s"))  # type: ignore[arg-type, return-value]
    seen = []
    for episode in (5, 5, 6):
        sensor.restart(episode)
        for _ in range(3):
            world.version += 1
            seen.append(sensor.read(0.0).image)
    np.testing.assert_array_equal(seen[:3], seen[3:6])
    assert len({image.tobytes() for image in seen}) == 6
    assert (seen[0].astype(float) - render(flat())).std() == pytest.approx(1.53, rel=0.05)


def dotted(sensor: HiddenSensor, image: np.ndarray) -> np.ndarray:
    """The picture with dots printed on its gel, which a ball's press hardly moves."""
    dots = lattice_points(7, 9, 1.9e-3 / PITCH) + np.array([(image.shape[1] - 1) / 2, (image.shape[0] - 1) / 2])
    ink = draw(dots, 0.3e-3 / PITCH, image.shape[:2], np.full(image.shape, 200.0)) / 200.0
    return np.clip(np.rint(image * ink), 0, 255).astype(np.uint8)


@pytest.mark.slow
def test_calibrate_sensor_measures_or_reports_markers(tmp_path: Path) -> None:
    sensor, home = HiddenSensor(2), tmp_path / "frames"
    home.mkdir()
    for i, press in enumerate(sensor.presses(5)):
        save_picture(home / f"press_{i}.png", dotted(sensor, press.image))
    save_picture(home / "background.png", dotted(sensor, sensor.empty()))
    words = ["calibrate", "sensor", str(home), "--ball-radius", f"{BALL} m", "--pixel-pitch", f"{PITCH} m"]
    ran = tacsim(*words, "--markers", "--marker-pitch", "1.9 mm", "--out", tmp_path / "out")
    assert ran.exit_code == 0, ran.output
    assert "markers: 7 x 9, 1.9 mm apart, radius 0.3" in ran.stderr
    assert "<li>markers: 7 x 9, 1.9 mm apart" in (tmp_path / "out" / "verdict.html").read_text(encoding="utf-8")
    calibration, reference = read_bundle(tmp_path / "out")
    markers = calibration.markers
    assert markers is not None and (markers.rows, markers.columns) == (7, 9)
    assert markers.pitch == pytest.approx(1.9e-3, rel=0.01) and markers.radius == pytest.approx(0.3e-3, rel=0.15)
    normalise = normaliser_for_calibration(calibration, CanonicalGrid(), reference)
    normalise.take_reference(TactileFrame(image=reference, time=0.0, index=0))
    pressed = dotted(sensor, sensor.press(0.5e-3, 130, 100).image)
    seen = normalise(TactileFrame(image=pressed, time=0.1, index=1), 0.1)
    assert seen.flow is not None and np.median(np.abs(seen.flow)) < 10e-6 and normalise.visible_marker_share > 0.9
    assert seen.height is not None and 0.35e-3 < float(seen.height.max()) < 0.65e-3

    ran = tacsim(*words, "--out", tmp_path / "plain")
    assert ran.exit_code == 3, ran.output  # a rig would refuse it
    assert "dots are printed on the gel, and each will pass for a dent. Next: give --markers" in ran.stderr
    for path in home.iterdir():
        save_picture(path, sensor.presses(1)[0].image if path.stem != "background" else sensor.empty())
    ran = tacsim(*words, "--markers", "--out", tmp_path / "none")
    assert ran.exit_code == 2 and "leave --markers out" in plain_text(ran.stderr)
    assert not (tmp_path / "none").exists()


@pytest.mark.slow
def test_calibrate_sensor_fine_images_use_coarser_pitch(folder: Path, tmp_path: Path) -> None:
    """Eight times as many pixels each way: the same heights, and native pictures are what the bundle is for."""
    import cv2

    for path in folder.glob("*.png"):
        image = np.asarray(Image.open(path))
        save_picture(path, cv2.resize(image, None, fx=8, fy=8, interpolation=cv2.INTER_CUBIC))
    lengths = ["--ball-radius", f"{BALL * 1e3} mm", "--pixel-pitch", f"{PITCH / 8 * 1e3} mm"]
    known = ("--size", SIZE, "--depth", "press_2.png=0.65 mm")
    ran = tacsim("calibrate", "sensor", folder, *lengths, *known, "--out", tmp_path / "out")
    assert ran.exit_code == 0 and "verdict: good" in ran.output, ran.output
    calibration, reference = read_bundle(tmp_path / "out")
    assert calibration.image_shape == (8 * ROWS, 8 * COLUMNS) and reference.shape[1] < 400
    assert calibration.geometry.pixel_pitch == pytest.approx(0.0625e-3, rel=0.01)
    normalise = normaliser_for_calibration(calibration, CanonicalGrid(), reference)
    sight = [np.asarray(Image.open(folder / name)) for name in ("Background.png", "press_2.png")]
    normalise.take_reference(TactileFrame(image=sight[0], time=0.0, index=0))
    seen = normalise(TactileFrame(image=sight[1], time=0.1, index=1), 0.1)
    assert seen.height is not None and normalise.reference_doubt is None
    assert float(seen.height.max()) == pytest.approx(0.65e-3, rel=0.1)

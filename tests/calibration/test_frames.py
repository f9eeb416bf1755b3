from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from calibration.ballpress import BadPresses
from calibration.frames import read_presses
from tests.calibration.presses import BALL, PITCH, HiddenSensor


def save(path: Path, image: np.ndarray) -> None:
    Image.fromarray(image).save(path)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    sensor = HiddenSensor(2)
    home = tmp_path / "frames"
    home.mkdir()
    for i, press in enumerate(sensor.presses(5)):
        save(home / f"press_{i}.png", press.image)
    save(home / "Background.png", sensor.empty())
    (home / "notes.txt").write_text("not a picture", encoding="utf-8")
    return home


def test_the_frame_without_contact_is_told_by_its_name(folder: Path) -> None:
    frames = read_presses(folder)
    assert [name for name, _ in frames.presses] == [f"press_{i}.png" for i in range(5)]
    assert not frames.estimated


def test_or_is_named_or_is_the_median(folder: Path) -> None:
    untouched = read_presses(folder).reference
    moved = folder.parent / "elsewhere.png"
    (folder / "Background.png").rename(moved)
    np.testing.assert_array_equal(read_presses(folder, moved).reference, untouched)
    median = read_presses(folder)
    assert median.estimated
    assert np.abs(median.reference.astype(int) - untouched).mean() < 2.5
    (folder / "press_0.png").unlink()
    with pytest.raises(BadPresses, match="--reference"):
        read_presses(folder)


def test_what_cannot_be_read_is_named(folder: Path) -> None:
    (folder / "press_9.png").write_bytes(b"no picture")
    with pytest.raises(BadPresses, match=r"press_9\.png"):
        read_presses(folder)
    with pytest.raises(BadPresses, match="is no folder"):
        read_presses(folder / "press_0.png")
    empty = folder.parent / "empty"
    empty.mkdir()
    with pytest.raises(BadPresses, match="holds no frame of a press"):
        read_presses(empty)


def test_the_command_writes_a_bundle_and_a_picture(folder: Path, tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from calibration.bundle import read_bundle
    from robot.cli import app

    lengths = ["--ball-radius", f"{BALL * 1e3} mm", "--pixel-pitch", f"{PITCH * 1e3} mm"]
    out = tmp_path / "out"
    ran = CliRunner().invoke(app, ["calibrate", "sensor", str(folder), *lengths, "--serial", "s1", "--out", str(out)])
    assert ran.exit_code == 0, ran.output
    calibration, _ = read_bundle(out, "s1")
    assert len(calibration.residuals) == 5
    assert calibration.geometry.pixel_pitch == pytest.approx(PITCH)
    assert (out / "residuals.png").stat().st_size > 10_000
    assert "press_3.png" in ran.output
    again = CliRunner().invoke(app, ["calibrate", "sensor", str(folder), *lengths, "--out", str(out)])
    assert again.exit_code == 2
    assert "overwritten" in again.output
    nothing = CliRunner().invoke(
        app, ["calibrate", "sensor", str(tmp_path / "none"), *lengths, "--out", str(out) + "2"]
    )
    assert nothing.exit_code == 2
    assert "folder" in nothing.output
    assert "Traceback" not in nothing.output


def dotted(sensor: HiddenSensor, image: np.ndarray) -> np.ndarray:
    """The picture with dots printed on its gel, which a ball's press hardly moves."""
    from tests.calibration.dotted import draw, lattice_points

    dots = lattice_points(7, 9, 1.9e-3 / PITCH) + np.array([(image.shape[1] - 1) / 2, (image.shape[0] - 1) / 2])
    ink = draw(dots, 0.3e-3 / PITCH, image.shape[:2], np.full(image.shape, 200.0)) / 200.0
    return np.clip(np.rint(image * ink), 0, 255).astype(np.uint8)


def test_markers_are_measured_when_asked_for_and_noticed_when_not(tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from calibration.bundle import read_bundle
    from calibration.normaliser import for_calibrated
    from robot.cli import app
    from tacsim.interface import TactileFrame
    from tacsim.optics.geometry import CanonicalGrid

    sensor, home = HiddenSensor(2), tmp_path / "frames"
    home.mkdir()
    for i, press in enumerate(sensor.presses(5)):
        save(home / f"press_{i}.png", dotted(sensor, press.image))
    save(home / "background.png", dotted(sensor, sensor.empty()))
    words = ["calibrate", "sensor", str(home), "--ball-radius", f"{BALL} m", "--pixel-pitch", f"{PITCH} m"]
    ran = CliRunner().invoke(app, [*words, "--markers", "--out", str(tmp_path / "out")], env={"COLUMNS": "200"})
    assert ran.exit_code == 0, ran.output
    assert "markers: 7 x 9, 1.9 mm apart, radius 0.3" in ran.stderr
    calibration, reference = read_bundle(tmp_path / "out")
    markers = calibration.markers
    assert markers is not None and (markers.rows, markers.columns) == (7, 9)
    assert markers.pitch == pytest.approx(1.9e-3, rel=0.01) and markers.radius == pytest.approx(0.3e-3, rel=0.15)
    normalise = for_calibrated(calibration, CanonicalGrid(), reference)
    normalise.take_reference(TactileFrame(image=reference, time=0.0, index=0))
    pressed = dotted(sensor, sensor.press(0.5e-3, 130, 100).image)
    seen = normalise(TactileFrame(image=pressed, time=0.1, index=1), 0.1)
    assert seen.flow is not None and np.median(np.abs(seen.flow)) < 10e-6 and normalise.kept > 0.9
    assert seen.height is not None and 0.35e-3 < float(seen.height.max()) < 0.65e-3

    ran = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "plain")], env={"COLUMNS": "200"})
    assert ran.exit_code == 0, ran.output
    assert "dots seem to be printed on the gel; give --markers" in ran.stderr
    for path in home.iterdir():
        save(path, sensor.presses(1)[0].image if path.stem != "background" else sensor.empty())
    ran = CliRunner().invoke(app, [*words, "--markers", "--out", str(tmp_path / "none")], env={"COLUMNS": "200"})
    assert ran.exit_code == 2 and "leave --markers out" in " ".join(ran.stderr.replace("│", " ").split())
    assert not (tmp_path / "none").exists()

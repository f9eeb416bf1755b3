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

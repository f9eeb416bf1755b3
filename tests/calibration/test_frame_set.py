from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from calibration.errors import BadFrames
from calibration.frame_set import read_folder, rectified_by_view
from calibration.lens.view import view_of_corners
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
    frames = read_folder(folder)
    assert [frame.name for frame in frames.frames] == [f"press_{i}.png" for i in range(5)]
    assert not frames.estimated


def test_more_frames_without_contact_have_its_name_and_a_number(folder: Path) -> None:
    for number in (10, 2):
        save(folder / f"background_{number}.png", np.full_like(read_folder(folder).reference, number))
    frames = read_folder(folder)
    assert [frame.name for frame in frames.frames] == [f"press_{i}.png" for i in range(5)]
    assert sorted(int(image.max()) for image in frames.untouched_images[1:]) == [2, 10]
    np.testing.assert_array_equal(frames.untouched_images[0], frames.reference)
    # presses are presses, though the reference that is named has their name
    (folder / "Background.png").rename(folder / "press.png")
    named = read_folder(folder, folder / "press.png")
    assert len(named.frames) == 5 and len(named.untouched_images) == 3
    np.testing.assert_array_equal(named.reference, frames.reference)


def test_all_frames_are_rectified_and_must_fit_the_view(folder: Path) -> None:
    view = view_of_corners(((20.0, 10.0), (240.0, 15.0), (235.0, 190.0), (15.0, 185.0)), (16e-3, 12e-3), (200, 260))
    save(folder / "background_2.png", HiddenSensor(5).empty())
    frames = read_folder(folder)
    seen = rectified_by_view(frames, view)
    shape = (view.geometry.height, view.geometry.width, 3)
    assert {image.shape for image in (*seen.untouched_images, *(frame.image for frame in seen.frames))} == {shape}
    np.testing.assert_array_equal(seen.untouched_images[0], seen.reference)
    assert (seen.untouched_images[1] != seen.reference).any()
    save(folder / "background_2.png", HiddenSensor(5).empty()[:100])
    with pytest.raises(BadFrames, match="260 x 200"):
        rectified_by_view(read_folder(folder), view)


def test_or_is_named_or_is_the_median(folder: Path) -> None:
    untouched = read_folder(folder).reference
    moved = folder.parent / "elsewhere.png"
    (folder / "Background.png").rename(moved)
    np.testing.assert_array_equal(read_folder(folder, moved).reference, untouched)
    median = read_folder(folder)
    assert median.estimated
    assert np.abs(median.reference.astype(int) - untouched).mean() < 2.5
    (folder / "press_0.png").unlink()
    with pytest.raises(BadFrames, match="--reference"):
        read_folder(folder)


def test_what_cannot_be_read_is_named(folder: Path) -> None:
    (folder / "press_9.png").write_bytes(b"no picture")
    with pytest.raises(BadFrames, match=r"press_9\.png"):
        read_folder(folder)
    with pytest.raises(BadFrames, match="is no folder"):
        read_folder(folder / "press_0.png")
    empty = folder.parent / "empty"
    empty.mkdir()
    with pytest.raises(BadFrames, match="no pictures in this folder"):
        read_folder(empty)


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
    assert calibration.noise is not None and "noise, from beside the contacts: R, G, B" in ran.output
    again = CliRunner().invoke(app, ["calibrate", "sensor", str(folder), *lengths, "--out", str(out)])
    assert again.exit_code == 2
    assert "overwritten" in again.output
    nothing = CliRunner().invoke(
        app, ["calibrate", "sensor", str(tmp_path / "none"), *lengths, "--out", str(out) + "2"]
    )
    assert nothing.exit_code == 2
    assert "folder" in nothing.output
    assert "Traceback" not in nothing.output


def test_the_command_ends_in_a_verdict(folder: Path, tmp_path: Path) -> None:
    """Two presses are not enough: the exit code is 3, the bundle and the page say why."""
    from typer.testing import CliRunner

    from calibration.bundle import read_bundle
    from robot.cli import app

    for number in (2, 3, 4):
        (folder / f"press_{number}.png").unlink()
    lengths = ["--ball-diameter", f"{2e3 * BALL} mm", "--kind", "digit", "--pixel-pitch", f"{PITCH * 1e3} mm"]
    ran = CliRunner().invoke(app, ["calibrate", "sensor", str(folder), *lengths, "--out", str(tmp_path / "out")])
    assert ran.exit_code == 3, ran.output
    assert "verdict: do not trust" in ran.output and "press five at least" in ran.output
    assert "11.4 x 15.2 mm of the gel" in ran.output  # a DIGIT's picture shows less
    calibration, _ = read_bundle(tmp_path / "out")
    assert calibration.provenance.ball_radius == pytest.approx(BALL)
    assert calibration.provenance.warnings[0].startswith("verdict: do not trust")
    assert "do not trust" in (tmp_path / "out" / "verdict.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--ball-radius", "2.92", "--pixel-pitch", "0.06 mm"), "'2.92' has no unit; say '2.92 mm'"),
        (("--ball-radius", "2.92 mm", "--pixel-pitch", "6e-5"), "has no unit"),
        (("--ball-radius", "2.92 m", "--pixel-pitch", "0.06 mm"), "allowed"),
        (("--ball-radius", "3 mm", "--ball-diameter", "6 mm", "--pixel-pitch", "0.06 mm"), "not both"),
        (("--ball-diameter", "6 mm", "--kind", "minni"), "known: mini,"),
        (("--ball-diameter", "6 mm", "--kind", "other"), "--pixel-pitch or --view"),
    ],
)
def test_the_command_refuses_lengths_that_may_be_wrong(folder: Path, words: tuple[str, ...], said: str) -> None:
    from typer.testing import CliRunner

    from robot.cli import app

    ran = CliRunner().invoke(app, ["calibrate", "sensor", str(folder), *words], env={"COLUMNS": "300"})
    assert ran.exit_code == 2
    assert said in ran.output


def test_the_command_measures_the_cameras_noise(folder: Path, tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from calibration.bundle import read_bundle, read_sensor_model
    from robot.cli import app
    from tacsim.interface import SensorSpec
    from tacsim.optics.noise import noise_source
    from tacsim.optics.render import Renderer
    from tacsim.sim.sensor import SimSensor
    from tests.tacsim.optics.surfaces import flat

    again = HiddenSensor(2)  # the same untouched gel, whose light drifts
    for number in (1, 2, 3):
        image = again.photograph(np.zeros((200, 260, 2)), drift=2.0 * number)
        save(folder / f"background_{number}.png", image)
    words = ["calibrate", "sensor", str(folder), "--ball-radius", f"{BALL} m", "--pixel-pitch", f"{PITCH} m"]
    ran = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "out")], env={"COLUMNS": "200"})
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
    from tests.calibration.dotted import draw, lattice_points

    dots = lattice_points(7, 9, 1.9e-3 / PITCH) + np.array([(image.shape[1] - 1) / 2, (image.shape[0] - 1) / 2])
    ink = draw(dots, 0.3e-3 / PITCH, image.shape[:2], np.full(image.shape, 200.0)) / 200.0
    return np.clip(np.rint(image * ink), 0, 255).astype(np.uint8)


def test_markers_are_measured_when_asked_for_and_noticed_when_not(tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from calibration.bundle import read_bundle
    from calibration.normaliser import normaliser_for_calibration
    from robot.cli import app
    from tacsim.interface import TactileFrame
    from tacsim.models.sensor import CanonicalGrid

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
    normalise = normaliser_for_calibration(calibration, CanonicalGrid(), reference)
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

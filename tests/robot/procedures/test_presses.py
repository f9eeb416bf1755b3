"""Presses by hand before a camera: a person played by the test, who does what the command asks for."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from calibration.bundle import FILE, read_bundle
from calibration.errors import BadFrames
from calibration.lens.view import view_of_corners
from calibration.light.noise import measure_noise
from robot.fixtures import mock_host
from robot.mock import MockCamera
from robot.procedures.presses import NOISE_FRAMES, REFERENCE, BallPressPlan, record_presses
from robot.procedures.session import CannotCalibrate, Session, handheld_camera
from tacsim.config import load_rig
from tacsim.interface import EndOfEpisode, TactileFrame
from tacsim.record.images import read_image
from tests.calibration.dotted import draw, lattice_points
from tests.calibration.presses import BALL, BALL_PX, COLUMNS, PITCH, ROWS, HiddenSensor
from tests.robot.cli.invoked import START, plain_text, tacsim

SENSOR = HiddenSensor(3)
EMPTY = SENSOR.empty()
UNTOUCHED = [REFERENCE, *(f"background_{k}.png" for k in range(1, NOISE_FRAMES))]
MADE = SENSOR.presses(8)
PRESSES = [press.image for press in MADE]


class Person:
    """A camera whose clock is a tenth of a second a frame, and a person who shows it `moves`, one per requested
    press."""

    def __init__(
        self, moves: list[np.ndarray | Callable[[int], np.ndarray]], *, lifts: bool = True, empty: np.ndarray = EMPTY
    ) -> None:
        self.said: list[str] = []
        self._moves, self._lifts, self._empty = iter(moves), lifts, empty
        self._shown: np.ndarray | Callable[[int], np.ndarray] = empty
        self._index = 0
        self._rng = np.random.default_rng(0)

    def read(self, timeout: float) -> TactileFrame:
        self._index += 1
        image = self._shown(self._index) if callable(self._shown) else self._shown
        noisy = np.clip(np.rint(image + self._rng.normal(0, 1.5, image.shape)), 0, 255).astype(np.uint8)
        return TactileFrame(image=noisy, time=0.1 * self._index, index=self._index)

    def hear(self, words: str) -> None:
        self.said.append(words)
        if re.match(r"Press \d", words):
            move = next(self._moves, None)
            if move is None:
                raise EndOfEpisode("nobody is there any more")
            self._shown = move
        elif words.startswith("Lift") and self._lifts:
            self._shown = self._empty
        elif words.startswith("Still moving"):
            self._shown = PRESSES[0]

    def led(self, presses: int = 5, **options: object) -> tuple[Session[tuple[str, np.ndarray]], dict[str, np.ndarray]]:
        kept: dict[str, np.ndarray] = {}
        session: Session[tuple[str, np.ndarray]] = Session(report=self.hear, store=lambda item: kept.update([item]))
        self.untouched = record_presses(self, BallPressPlan(BALL_PX, presses, **options), session)  # type: ignore[arg-type]
        return session, kept

    def refused(self) -> list[str]:
        return [words for words in self.said if words.startswith("Not taken")]


def test_presses_guide_person_through_all_presses() -> None:
    person = Person(PRESSES[:5])
    record, kept = person.led()
    assert list(kept) == [*UNTOUCHED, *(f"press_0{k}.png" for k in range(1, 6))]
    assert measure_noise(person.untouched).deviation == pytest.approx([1.53] * 3, rel=0.03)
    assert person.refused() == record.left_out == []
    for (name, image), shown in zip(record.measurements, PRESSES, strict=False):
        assert kept[name] is image
        assert np.abs(image.astype(int) - shown).mean() < 2.5
    asked = [words for words in person.said if words.startswith("Press ")]
    assert asked[0].startswith("Press 1 of 5: press the ball into the gel, at the middle of the picture")
    places = [re.search(r"at the (.*) of the picture", words)[1] for words in asked]  # type: ignore[index]
    assert len(set(places)) >= 4  # this person does not follow the positions
    assert person.said[0].startswith("Take everything off")
    assert sum(words.startswith("Lift") for words in person.said) == 5


def finger() -> np.ndarray:
    """A shadow with a ragged edge, and no ball's dent."""
    shadow = np.random.default_rng(1).integers(-60, 60, (ROWS // 20, COLUMNS // 20, 3)).repeat(20, 0).repeat(20, 1)
    return np.clip(EMPTY + shadow, 0, 255).astype(np.uint8)


def glaring() -> np.ndarray:
    """A contact in whose middle a lamp is mirrored."""
    image = SENSOR.press(0.5e-3, 130, 100).image
    v, u = np.mgrid[:ROWS, :COLUMNS]
    image[np.hypot(u - 130, v - 100) < 12] = 255
    return image


@pytest.mark.parametrize(
    ("move", "why"),
    [
        (finger(), "no ball's contact is seen"),
        (PRESSES[0], "it is in the same place as press 1; press elsewhere"),
        (glaring(), r"saturated: shorten the exposure|no ball's contact"),
        (SENSOR.press(0.5e-3, 8, 100).image, "the contact is cut off by the border of the picture"),
        (
            np.maximum(PRESSES[1], PRESSES[3]),
            "there is a second contact in the picture, or one in the picture without contact; press one ball at a time",
        ),
    ],
    ids=["no ball", "same place", "saturated", "cut off", "two balls"],
)
def test_presses_unusable_press_is_requested_again(move: np.ndarray, why: str) -> None:
    person = Person([PRESSES[0], move, PRESSES[1]])
    record, kept = person.led(2)
    assert len(record.measurements) == 2 and len(kept) == len(UNTOUCHED) + 2
    assert np.abs(record.measurements[1][1].astype(int) - PRESSES[1]).mean() < 2.5
    (said,) = person.refused()
    assert re.search(why, said)
    assert [words[:12] for words in person.said].count("Press 2 of 2") == 2


def test_presses_marked_gel_is_judged_without_dots() -> None:
    dots = lattice_points(8, 10, 24.0) + [(COLUMNS - 1) / 2, (ROWS - 1) / 2]

    def dotted(image: np.ndarray, by: float) -> np.ndarray:
        return draw(dots + by, 4.0, (ROWS, COLUMNS), image.astype(float))

    marked = Person([dotted(PRESSES[0], 2.0)], empty=dotted(EMPTY, 0.0))
    record, _ = marked.led(1, markers=True)
    assert record.left_out == [] and len(record.measurements) == 1
    with pytest.raises(BadFrames, match="omit --markers"):
        Person([PRESSES[0]]).led(1, markers=True)


def test_presses_moving_press_waits_for_rest() -> None:
    def sliding(index: int) -> np.ndarray:
        return np.roll(PRESSES[0], 2 * (index % 20), axis=1)

    person = Person([sliding])
    record, _ = person.led(1)
    assert any(words.startswith("Still moving") for words in person.said)
    assert np.abs(record.measurements[0][1].astype(int) - PRESSES[0]).mean() < 2.5  # held still, then


def test_presses_slow_creep_is_motion() -> None:
    depths = iter(np.r_[np.linspace(0.2e-3, 0.6e-3, 40), np.full(200, 0.6e-3)])
    person = Person([lambda index: SENSOR.press(float(next(depths)), 130, 100).image])
    record, _ = person.led(1)
    deepest = SENSOR.press(0.6e-3, 130, 100).image
    assert np.abs(record.measurements[0][1].astype(int) - deepest).mean() < 3.5


def test_presses_early_end_keeps_measurements() -> None:
    record, kept = Person(PRESSES[:2]).led(5)
    assert len(record.measurements) == 2 and len(kept) == len(UNTOUCHED) + 2


@pytest.mark.slow
def test_presses_without_action_time_out() -> None:
    with pytest.raises(CannotCalibrate, match="nothing touched the gel"):
        Person([EMPTY]).led(1, timeout=20.0)
    with pytest.raises(CannotCalibrate, match="does not look as it did before the presses"):
        Person(PRESSES, lifts=False).led(2, timeout=20.0)

    person = Person([])
    person._shown = lambda index: np.roll(PRESSES[0], 3 * index, axis=1)
    with pytest.raises(CannotCalibrate, match="does not come to rest"):
        person.led(1, timeout=20.0)


def test_presses_dark_reference_raises() -> None:
    person = Person([])
    person._shown = np.zeros_like(EMPTY)
    with pytest.raises(BadFrames, match="is dark"):
        person.led(1)


def test_handheld_camera_without_gel_raises() -> None:
    with pytest.raises(CannotCalibrate, match="is not a sensor with a camera; such sensors: none"):
        handheld_camera(load_rig("sim").config, "lower")
    with pytest.raises(CannotCalibrate, match="its gel cannot be pressed by hand"):
        handheld_camera(load_rig("mock").config, "lower")
    assert handheld_camera(load_rig("ur5e").config, "upper").driver == "camera"


RIG = """
name: bench
clock: wall
sensors:
  finger: {{ driver: camera, source: '{source}', width: {width}, height: {height}, fps: 30, max_age: 10 s }}
"""
QUESTION = ("[y/N]:", "[Y/n]:")


@contextmanager
def bench(folder: Path, number: int, empty: np.ndarray = EMPTY) -> Iterator[tuple[MockCamera, Path]]:
    """A camera that shows an untouched gel, and a rig file with it."""
    size = {"width": empty.shape[1], "height": empty.shape[0]}
    with MockCamera(mock_host(number), fps=30.0, quality=100, stamped=False, **size) as camera:
        camera.push(empty)
        path = folder / "bench.yaml"
        path.write_text(RIG.format(source=camera.url, **size))
        yield camera, path


def lead(
    camera: MockCamera,
    words: list[str],
    answer: str | None,
    stop_after: int = 99,
    seen: Callable[[np.ndarray], np.ndarray] = lambda image: image,
) -> tuple[int, list[str]]:
    """Runs the command and plays the person by what it says. answer: typed at its terminal; None: it has none; seen:
    how the camera shows the gel."""
    moves, lines, taken = iter(PRESSES), [], 0
    answers = iter([] if answer is None else answer.splitlines())
    ours, theirs = pty.openpty() if answer is not None else os.pipe()
    with subprocess.Popen(
        [*START, *words], stdin=subprocess.DEVNULL if answer is None else theirs, stdout=subprocess.DEVNULL,
        stderr=theirs, env={**os.environ, "COLUMNS": "200", "TERM": "dumb"},
    ) as process:  # fmt: skip
        os.close(theirs)
        for line in said(ours):
            lines.append(line.strip())
            if line.endswith(QUESTION):
                os.write(ours, next(answers).encode() + b"\n")
            elif re.search(r"Press \d+ of", line):
                camera.push(seen(next(moves)))
            elif line.startswith("Taken"):
                taken += 1
                if taken == stop_after:
                    process.send_signal(signal.SIGINT)
            elif line.startswith("Lift"):
                camera.push(seen(EMPTY))
    os.close(ours)
    return process.returncode, lines


def said(source: int) -> Iterator[str]:
    """Lines from a pipe or a terminal, and questions, which end without one."""
    text = ""
    while True:
        try:
            more = os.read(source, 4096).decode()
        except OSError:  # how a terminal ends
            more = ""
        if not more:
            return
        *lines, text = re.split(r"[\r\n]+", text + more)
        yield from lines
        if text.endswith(QUESTION):
            yield text
            text = ""


@pytest.mark.deep
@pytest.mark.timeout(300)
@pytest.mark.parametrize("answer", [None, "n\ny\n"], ids=["no terminal", "a terminal"])
def test_command_writes_bundle_and_frames(answer: str | None, tmp_path: Path) -> None:
    out = tmp_path / "out"
    lengths = ["--ball-radius", f"{BALL * 1e3} mm", "--pixel-pitch", f"{PITCH * 1e3} mm", "--serial", "s1"]
    with bench(tmp_path, 61) as (camera, rig):
        words = ["calibrate", "sensor", "--camera", f"{rig}/finger", *lengths, "--presses", "5", "--out", str(out)]
        code, lines = lead(camera, words, answer)
    assert code == 4, lines  # nothing checks its lengths
    assert any("Is nothing touching the gel?" in line for line in lines) == (answer is not None)
    assert any("Take everything off the gel first." in line for line in lines) == (answer is not None)
    live, reference = read_bundle(out, "s1")
    assert len(live.residuals) == 5 and live.provenance.left_out == {}
    np.testing.assert_array_equal(read_image(out / "frames" / REFERENCE), reference)
    assert np.abs(reference.astype(int) - EMPTY).mean() < 2.0  # JPEG halves the resolution of colour
    # from the frames, the same again
    words = ["calibrate", "sensor", str(out / "frames"), *lengths, "--out", str(tmp_path / "again")]
    done = tacsim(*words)
    assert done.exit_code == 4, done.output
    again, _ = read_bundle(tmp_path / "again")
    assert again.forward == live.forward and again.inverse == live.inverse
    assert live.noise is not None and again.noise == live.noise
    assert 0.5 < np.mean(live.noise.deviation) < 2.0  # as the mock camera has it


@pytest.mark.deep
@pytest.mark.timeout(300)
def test_command_tilted_camera_uses_view(tmp_path: Path) -> None:
    """Reports and bundle use the metric picture; stored pictures are those of the camera."""
    corners = ((30.0, 22.0), (295.0, 15.0), (285.0, 220.0), (25.0, 225.0))
    edges = np.array([(0, 0), (COLUMNS, 0), (COLUMNS, ROWS), (0, ROWS)], dtype=np.float32) - 0.5
    askew = cv2.getPerspectiveTransform(edges, np.array(corners, dtype=np.float32))

    def seen(image: np.ndarray) -> np.ndarray:
        return np.asarray(cv2.warpPerspective(image, askew, (320, 240), borderMode=cv2.BORDER_REPLICATE))

    view = view_of_corners(corners, (COLUMNS * PITCH, ROWS * PITCH), (240, 320))
    (tmp_path / "view.yaml").write_text(yaml.safe_dump(view.model_dump(mode="json")))
    out, count = tmp_path / "out", 5
    options = ["--ball-radius", f"{BALL} m", "--view", str(tmp_path / "view.yaml")]
    with bench(tmp_path, 68, seen(EMPTY)) as (camera, rig):
        words = ["calibrate", "sensor", "--camera", f"{rig}/finger", *options, "--presses", str(count)]
        code, lines = lead(camera, [*words, "--out", str(out)], None, seen=seen)
    assert code == 4, lines  # nothing checks its lengths
    calibration, reference = read_bundle(out)
    assert calibration.view == view and calibration.geometry == view.geometry
    assert reference.shape == (view.geometry.height, view.geometry.width, 3)
    assert read_image(out / "frames" / REFERENCE).shape == (240, 320, 3)
    truth = [press.circle for press in MADE[:count]]
    scale = PITCH / view.pixel_pitch  # pixels of the rectified picture are not those of the made-up gel
    told = [re.match(r"Taken: contact at (\d+), (\d+) px, radius (\d+) px", line) for line in lines]
    circles = [[float(number) for number in match.groups()] for match in told if match]
    assert len(circles) == len(calibration.residuals) == count
    for (x, y, radius), (true_x, true_y, true_radius), residual in zip(
        circles, truth, calibration.residuals, strict=True
    ):
        assert (x, y) == pytest.approx(((true_x + 0.5) * scale - 0.5, (true_y + 0.5) * scale - 0.5), abs=2.0)
        assert radius == pytest.approx(true_radius * scale, abs=2.5)
        assert residual.circle[2] * view.pixel_pitch == pytest.approx(true_radius * PITCH, rel=0.08)
    assert np.median([residual.angle for residual in calibration.residuals]) < 4.0
    again = ["calibrate", "sensor", str(out / "frames"), *options, "--out", str(tmp_path / "again")]
    done = tacsim(*again)
    assert done.exit_code == 4, done.output
    assert read_bundle(tmp_path / "again")[0].forward == calibration.forward
    small = view_of_corners(((0.0, 0.0), (159.0, 0.0), (159.0, 119.0), (0.0, 119.0)), view.size, (120, 160))
    (tmp_path / "view.yaml").write_text(yaml.safe_dump(small.model_dump(mode="json")))
    refused = tacsim(*words, "--out", tmp_path / "no")
    assert refused.exit_code == 2 and "the view was calibrated on 160 x 120 px" in " ".join(refused.stderr.split())


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_command_ctrl_c_keeps_measurements(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with bench(tmp_path, 62) as (camera, rig):
        words = ["calibrate", "sensor", "--camera", f"{rig}/finger", "--ball-radius", f"{BALL} m"]
        words += ["--pixel-pitch", f"{PITCH} m", "--out", str(out)]
        code, lines = lead(camera, words, None, stop_after=2)
    assert code == 130, lines
    assert sorted(path.name for path in (out / "frames").iterdir()) == [*UNTOUCHED, "press_01.png", "press_02.png"]
    assert not (out / FILE).exists()
    assert any("2 presses are kept, nothing is calibrated" in line for line in lines)
    assert any(f"tacsim calibrate sensor {out / 'frames'}" in line for line in lines)


@pytest.mark.slow
def test_command_invalid_input_exits_2(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    rig = tmp_path / "bench.yaml"
    rig.write_text(RIG.format(source="http://127.0.0.1:9/", width=COLUMNS, height=ROWS))
    ball, pitch = ["--ball-radius", "2 mm"], ["--pixel-pitch", "0.08 mm"]
    for words, code, said in (
        ([*ball, *pitch], 2, "either a folder of frames, or --camera"),
        ([str(tmp_path / "frames"), "--camera", f"{rig}/finger", *ball, *pitch], 2, "either a folder of frames, or"),
        (["--camera", f"{rig}/finger", *pitch], 2, "give the ball's diameter (or its radius, not both)"),
        (["--camera", f"{rig}/finger", *ball], 2, "give --pixel-pitch or --view, or --kind"),
        (["--camera", "finger", *ball, *pitch], 2, "give rig and sensor"),
        (["--camera", f"{rig}/thumb", *ball, *pitch], 2, "'thumb' is not a sensor with a camera; such sensors: finger"),
        (["--camera", "mock/lower", *ball, *pitch], 2, "its gel cannot be pressed by hand"),
        (["--camera", f"{rig}/finger", *ball, *pitch], 1, "no picture from http://127.0.0.1:9/"),
    ):
        done = tacsim("calibrate", "sensor", *words, "--out", tmp_path / "out")
        assert done.exit_code == code, (words, done.output)
        assert said in plain_text(done.stderr), (words, done.output)
        assert not (tmp_path / "out").exists()

"""Views of a board by hand before a camera: a person played by the test, and the command on a mock camera."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from calibration.lens.view import GelView, Lens
from robot.fixtures import mock_host
from robot.mock import MockCamera
from robot.procedures.boards import ON_GEL, PROMPTS, BoardViewPlan, record_board_views
from robot.procedures.session import CannotCalibrate, Session
from tacsim.config import load_model
from tacsim.interface import EndOfEpisode, TactileFrame
from tacsim.record.images import encode_png, read_image
from tests.calibration.boards import DOTS, LENS, facing, photograph, tilted
from tests.robot.cli.invoked import START, plain_text, tacsim

Move = np.ndarray | Callable[[int], np.ndarray]
EMPTY = np.full((480, 640, 3), 128, np.uint8)
BOARD = ["--board", "dots:9x7:2.5 mm"]


@lru_cache
def views(number: int) -> list[np.ndarray]:
    return [photograph(DOTS, pose, seed=i) for i, pose in enumerate(tilted(DOTS, number))]


class Person:
    """A camera whose clock is a tenth of a second a frame; a person shows it `moves`, the next one whenever the last
    was taken or skipped."""

    def __init__(self, moves: list[Move]) -> None:
        self.said: list[str] = []
        self._moves, self._shown, self._index = iter(moves), EMPTY, 0

    def read(self, timeout: float) -> TactileFrame:
        self._index += 1
        image = self._shown(self._index) if callable(self._shown) else self._shown
        return TactileFrame(image=image, time=0.1 * self._index, index=self._index)

    def hear(self, words: str) -> None:
        self.said.append(words)
        if words.startswith(("View", "Skipped")):
            move = next(self._moves, None)
            if move is None:
                raise EndOfEpisode("nobody is there any more")
            self._shown = move

    def led(self, number: int, **options: object) -> tuple[Session[tuple[str, np.ndarray]], dict[str, np.ndarray]]:
        kept: dict[str, np.ndarray] = {}
        session: Session[tuple[str, np.ndarray]] = Session(report=self.hear, store=lambda item: kept.update([item]))
        record_board_views(self, BoardViewPlan(DOTS, number, **options), session)  # type: ignore[arg-type]
        return session, kept


def test_board_views_guide_person_through_all_views() -> None:
    person = Person(list(views(3)))
    record, kept = person.led(3)
    assert list(kept) == ["view_01.png", "view_02.png", "view_03.png"] and record.left_out == []
    for (name, image), shown in zip(record.measurements, views(3), strict=True):
        assert kept[name] is image
        np.testing.assert_array_equal(image, shown)
    asked = [words for words in person.said if words.startswith("View")]
    assert asked == [f"View {k} of 3: hold the board still, {PROMPTS[k - 1]}." for k in (1, 2, 3)]
    assert sum(words.startswith("Taken: 63 points") for words in person.said) == 3


def moving(index: int) -> np.ndarray:
    return np.roll(views(3)[1], 5 * (index % 8), axis=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("move", "why"),
    [
        (EMPTY, r"the board .* is not found; \d+ dots are seen, 63 should be"),
        (np.roll(views(3)[1], 200, axis=1), "is not found|on no plane|further dots"),
        (views(3)[0], "the board is as in view 1; tilt it, or hold it elsewhere"),
        (moving, "the board moves; hold it still"),
    ],
    ids=["no board", "cut off", "as before", "moving"],
)
def test_board_views_unusable_view_is_skipped_with_reason(move: Move, why: str) -> None:
    person = Person([views(3)[0], move, views(3)[2]])
    record, kept = person.led(2)
    (skipped,) = record.left_out
    assert re.search(why, skipped) and f"Skipped: {skipped}." in person.said
    assert len(kept) == 2
    np.testing.assert_array_equal(record.measurements[1][1], views(3)[2])


@pytest.mark.slow
def test_board_views_on_gel_takes_one_view_with_reference() -> None:
    faint = np.clip(128 + 0.1 * (views(1)[0].astype(float) - 128), 0, 255).astype(np.uint8)
    person = Person([faint])
    record, _ = person.led(1, on_gel=True, reference=EMPTY)
    assert len(record.measurements) == 1 and person.said[0] == f"View 1 of 1: {ON_GEL}."


@pytest.mark.slow
def test_board_views_end_on_stop_source_end_and_timeout() -> None:
    record, kept = Person(list(views(3)[:2])).led(6)
    assert len(record.measurements) == len(kept) == 2
    with pytest.raises(CannotCalibrate, match=r"after 6 s without a view; the last: the board .* is not found"):
        Person([EMPTY] * 9).led(1, timeout=6.0)
    never: Session[tuple[str, np.ndarray]] = Session(stop=lambda: True)
    record_board_views(Person([EMPTY]), BoardViewPlan(DOTS, 2), never)
    assert never.measurements == []


RIG = """
name: bench
clock: wall
sensors:
  eye: {{ driver: camera, source: '{source}', width: 640, height: 480, fps: 20, max_age: 10 s }}
"""


def lead(camera: MockCamera, words: list[str], moves: list[np.ndarray]) -> tuple[int, list[str]]:
    """Runs the command, and plays the person by what it says."""
    shown, lines = iter(moves), []
    with subprocess.Popen(
        [*START, *words], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "COLUMNS": "200", "TERM": "dumb"},
    ) as process:  # fmt: skip
        assert process.stderr is not None
        for line in process.stderr:
            lines.append(line.strip())
            if re.match("View |Skipped", line):
                camera.push(next(shown))
    return process.returncode, lines


@pytest.mark.deep
@pytest.mark.timeout(300)
def test_command_calibrates_lens_then_gel(tmp_path: Path) -> None:
    """One view without a board is skipped; the pictures give the same lens again; then the board lies on the gel."""
    out = tmp_path / "lens"
    moves = list(views(7))
    with MockCamera(mock_host(66), width=640, height=480, fps=20.0, quality=100, stamped=False) as camera:
        camera.push(EMPTY)
        (tmp_path / "bench.yaml").write_text(RIG.format(source=camera.url))
        words = ["calibrate", "lens", "--camera", f"{tmp_path / 'bench.yaml'}/eye", *BOARD]
        code, lines = lead(camera, [*words, "--views", "7", "--out", str(out)], [*moves[:3], EMPTY, *moves[3:]])
        assert code == 0, lines
        assert len([line for line in lines if re.search("Skipped: the board .* is not found", line)]) >= 1
        lens = load_model(Lens, out / "lens.yaml")
        np.testing.assert_allclose(lens.focal, LENS.focal, rtol=0.02)
        assert sorted(path.name for path in (out / "frames").iterdir()) == [f"view_0{k}.png" for k in range(1, 8)]
        again = ["calibrate", "lens", str(out / "frames"), *BOARD, "--out", str(tmp_path / "again")]
        done = tacsim(*again)
        assert done.exit_code == 0, done.output
        found = load_model(Lens, tmp_path / "again" / "lens.yaml")
        # OpenCV adds up in threads: the last digits differ from run to run.
        np.testing.assert_allclose([*found.focal, *found.centre], [*lens.focal, *lens.centre], rtol=1e-6)
        np.testing.assert_allclose(found.distortion, lens.distortion, atol=1e-6)
        flat = photograph(DOTS, facing(DOTS, [0.1, -0.1, 0.0], 0.032))
        words += ["--views", "1", "--lens", str(out / "lens.yaml"), "--size", "18 mm, 14 mm"]
        camera.push(EMPTY)
        code, lines = lead(camera, [*words, "--out", str(tmp_path / "view")], [flat])
        assert code == 0, lines
    view = load_model(GelView, tmp_path / "view" / "view.yaml")
    assert view.size == pytest.approx((18e-3, 14e-3)) and view.lens == lens
    assert read_image(tmp_path / "view" / "rectified.png").shape == (view.geometry.height, view.geometry.width, 3)


def test_command_invalid_input_exits_2(tmp_path: Path) -> None:
    rig = tmp_path / "bench.yaml"
    rig.write_text(RIG.format(source="http://127.0.0.1:9/"))
    live = ["--camera", f"{rig}/eye"]
    (tmp_path / "small.png").write_bytes(encode_png(EMPTY[:100]))
    for words, said in (
        (BOARD, "either pictures, or --camera"),
        ([str(tmp_path), *live, *BOARD], "either pictures, or --camera"),
        (live, "either --board or --corners"),
        ([*live, "--corners", "0,0,9,0,9,9,0,9"], "corners are positions in a picture"),
        ([*live, *BOARD, "--views", "4"], "a lens needs 6 views"),
        ([*live, *BOARD, "--reference", str(tmp_path / "small.png")], "it is 640 x 100 px"),
        (["--camera", "eye", *BOARD], "give rig and sensor"),
        (["--camera", "mock/lower", *BOARD], "has a mock camera with simulated pictures"),
    ):
        done = tacsim("calibrate", "lens", *words, "--out", tmp_path / "out")
        assert done.exit_code == 2, (words, done.output)
        assert said in plain_text(done.stderr), (words, done.output)
        assert not (tmp_path / "out").exists()

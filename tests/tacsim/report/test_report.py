"""Reports of made-up episodes: what is written, what is left out, and that names stay names."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from numpy.typing import NDArray
from PIL import Image
from rich.console import Console

from tacsim.interface import Action, ArmState, Pose, RigSpec, SensorSpec, TactileFrame
from tacsim.record.episode import Episode, EpisodeMeta, Step
from tacsim.report import figure
from tacsim.report.figure4 import Moment, Trial, draw_figure4
from tacsim.report.report import summarise, summary_table, write_report
from tacsim.report.series import Series

STEPS = 8


def made_up(
    sensors: tuple[str, ...] = ("lower", "upper"),
    arms: bool = True,
    reward: bool = True,
    rig: str = "bench",
    steps: int = STEPS,
    width: int = 64,
) -> Episode:
    """Force 0.5 N more each step on every arm, contact signal in proportion; closest to the goal at step 5."""
    carried = {name: SensorSpec((48, width), True, False, name if arms else None) for name in sensors}
    spec = RigSpec(carried, sensors if arms else (), truth=reward, period=0.1)
    meta = EpisodeMeta(rig, "squeeze", "scripted", 3, spec, {"tacsim": "0.2.0"}, goal=7e-3)
    return Episode(meta, [_step(k, sensors, arms, reward, width) for k in range(steps + 1)])


def numbers(episode: Episode) -> dict[str, Any]:
    return summarise(Series.from_episode(episode), complete=episode.complete, dropped=episode.dropped)


def _step(k: int, sensors: tuple[str, ...], arms: bool, reward: bool, width: int) -> Step:
    image = np.full((48, width, 3), 100 + k, np.uint8)
    wrench = np.array([9.0, 9.0, -0.5 * k, 0.0, 0.0, 0.0])
    distance = 1e-3 * abs(k - 5) + 0.1e-3
    return Step(
        index=k,
        time=0.1 * k,
        frames={name: TactileFrame(image, time=0.1 * k, index=k) for name in sensors},
        arms={name: ArmState(Pose(), np.zeros(6), wrench, None, 0.1 * k) for name in sensors} if arms else {},
        action=Action() if k else None,
        reward=-distance * 1e3 if reward else None,
        distance=distance if reward else None,
        info={f"contact_signal_{name}": 0.02 * k + 0.01 for name in sensors} | {"settled": float(k != 2)},
        seconds=99.0 if k == 0 else 0.1 * k,
    )


class Page(HTMLParser):
    """Tags, attributes and text of an HTML page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []
        self.text: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def test_summary_has_an_entry_for_each_control_step_and_none_for_the_reset() -> None:
    config = numbers(made_up())
    assert config["steps"] == STEPS
    for name in ("step", "reward", "distance", "force", "seconds"):
        assert len(config[name]) == STEPS, name
    assert config["step"] == list(range(1, STEPS + 1))
    assert config["force"][0] == {"lower": 0.5, "upper": 0.5}  # |Fz| alone, of step 1
    assert config["reward"][4] == pytest.approx(-0.1)
    assert config["seconds_per_step"] == pytest.approx(0.45)  # median of 0.1 .. 0.8; the reset's 99 s is no step
    assert config["contact_signal"]["upper"][0] == pytest.approx(0.03)
    assert config["correlation"] == pytest.approx({"lower": 1.0, "upper": 1.0})
    assert config["settled"] == STEPS - 1
    assert (config["rig"], config["task"], config["seed"], config["goal"]) == ("bench", "squeeze", 3, 7e-3)


def test_summary_is_valid_json_even_with_numbers_that_are_not() -> None:
    episode = made_up()
    steps = list(episode.steps)
    steps[3] = replace(steps[3], reward=float("nan"), distance=float("inf"))
    episode.steps = steps
    config = json.loads(json.dumps(numbers(episode), allow_nan=False))
    assert config["reward"][2] is None
    assert config["distance"][2] is None
    assert config["reward"][1] is not None


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1e308])
def test_numbers_that_no_report_can_draw_count_as_unknown(value: float, tmp_path: Path) -> None:
    """Those of a damaged recording, or of one made to break its reader; with pictures of one column too."""
    episode = made_up(width=1, steps=3)
    keys = ("contact_signal_upper", "alignment_upper", "limits_hit_upper", "packages_lost_upper", "stale_upper")
    arms = {"upper": ArmState(Pose(), np.zeros(6), np.full(6, value), None, 0.0)}
    episode.steps = [
        replace(
            step, time=value, seconds=value, reward=value, distance=value, info=dict.fromkeys(keys, value), arms=arms
        )
        for step in episode.steps
    ]
    episode.meta = replace(episode.meta, goal=(value, value))
    paths = write_report(episode, tmp_path)
    told = json.loads(paths["summary.json"].read_text(), parse_constant=lambda text: pytest.fail(text))
    assert told["reward"] == [None] * 3 and told["timing"] is None
    assert imread(paths["report.png"]).shape[0] < 5000


def test_step_numbers_survive_dropped_steps() -> None:
    episode = made_up()
    episode.steps = [step for step in episode.steps if step.index != 3]
    text = shown(episode)
    assert numbers(episode)["step"] == [1, 2, 4, 5, 6, 7, 8]
    assert "0.100 mm at step 5" in text


def test_correlation_is_undefined_when_nothing_changes() -> None:
    episode = made_up()
    episode.steps = [replace(step, info={"contact_signal_upper": 0.5}) for step in episode.steps]
    assert numbers(episode)["correlation"] == {"upper": None}
    assert figure.signal_against_force(Series.from_episode(episode))["upper"][2] is None


@pytest.mark.slow
def test_report_of_two_sensors(tmp_path: Path) -> None:
    episode = made_up(steps=30)
    paths = write_report(episode, tmp_path / "new")
    assert json.loads(paths["summary.json"].read_text())["steps"] == 30
    picture = imread(paths["report.png"])
    assert picture.shape[1] == int(figure.WIDTH * figure.DPI)
    assert picture.shape[0] > 800
    assert np.ptp(picture[..., :3]) > 0.5  # something is drawn
    html = paths["report.html"].read_text()
    page = Page(html)
    assert page.tags.count("img") == 2 * 6 + 1  # at most 6 frames a sensor, and the plots
    assert page.tags.count("script") == 2  # the data of the player, and the player
    assert all(link.startswith("data:image/") for link in page.links)
    assert not re.search(r"https?://|@import|url\(", html)
    frames = [_picture(link) for link in page.links[:6]]
    assert [int(frame[0, 0, 0]) for frame in (frames[0], frames[-1])] == [100, 130]


def _picture(link: str) -> NDArray[np.uint8]:
    return np.asarray(Image.open(BytesIO(base64.b64decode(link.partition(",")[2], validate=True))))


@pytest.mark.slow
def test_report_of_one_sensor_without_arms_and_reward(tmp_path: Path) -> None:
    episode = made_up(("finger",), arms=False, reward=False)
    paths = write_report(episode, tmp_path)
    config = json.loads(paths["summary.json"].read_text())
    assert config["reward"] == [None] * STEPS
    assert config["force"] == [{}] * STEPS
    assert config["correlation"] == {}
    assert imread(paths["report.png"]).shape[0] < imread(_two(tmp_path)).shape[0]
    assert Page(paths["report.html"].read_text()).tags.count("img") == 6 + 1
    assert "best distance" in shown(episode)


def _two(folder: Path) -> Path:
    return write_report(made_up(), folder / "two")["report.png"]


def test_names_from_a_file_stay_text(tmp_path: Path) -> None:
    evil = "</script><script>alert(1)</script> $\\frac$ [red]"
    paths = write_report(made_up((evil,), rig=evil), tmp_path)
    page = Page(paths["report.html"].read_text())
    assert page.tags.count("script") == 2
    assert any(evil in text for text in page.text)
    assert evil in shown(made_up(rig=evil))


def test_a_reset_alone_can_be_reported_and_nothing_cannot(tmp_path: Path) -> None:
    assert numbers(made_up(steps=0))["seconds_per_step"] is None
    assert write_report(made_up(steps=0), tmp_path)["report.png"].exists()
    with pytest.raises(ValueError, match="no steps"):
        write_report(Episode(made_up().meta), tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_half_of_a_report_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(figure: object, path: Path) -> None:
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("tacsim.report.figure.save_figure", full)
    with pytest.raises(OSError, match="No space left"):
        write_report(made_up(), tmp_path)
    assert not list(tmp_path.iterdir())


def test_table_names_the_best_the_peak_and_what_was_lost() -> None:
    episode = made_up()
    episode.dropped, episode.complete = 2, False
    text = shown(episode)
    for words in ("0.100 mm at step 5", "4.00 N", "-3.100", "0.450 s", "r = 1.000", "2 steps were not", "incomplete"):
        assert words in text


def test_of_equal_steps_the_first_is_named() -> None:
    """A policy that holds at the goal repeats its best step; the table and both plots name the same one."""
    episode = made_up()
    held = [replace(episode.steps[5], index=k) for k in (6, 7, 8)]
    episode.steps = [*episode.steps[:6], *held]
    text = shown(episode)
    assert "0.100 mm at step 5" in text
    assert "2.50 N (upper, step 5)" in text or "2.50 N (lower, step 5)" in text
    dots = [
        line
        for axes in figure.draw_plots(Series.from_episode(episode)).axes
        for line in axes.lines
        if line.get_marker() == "o"
    ]
    assert [list(line.get_xdata()) for line in dots] == [[5], [5]]  # of reward and of distance


def test_a_character_that_the_font_lacks_is_no_warning(tmp_path: Path) -> None:
    drawing = figure.new_figure(2.0, 1.0)
    drawing.text(0.1, 0.5, "\N{COLLISION SYMBOL}")
    figure.save_figure(drawing, tmp_path / "a.png")  # warnings are errors in tests
    assert (tmp_path / "a.png").stat().st_size > 0


def test_a_nearly_constant_force_is_not_cut_off() -> None:
    episode = made_up()
    wrench = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
    arms = {"upper": ArmState(Pose(), np.zeros(6), wrench, None, 0.0)}
    episode.steps = [replace(step, arms=arms) for step in episode.steps]
    (force,) = (axes for axes in figure.draw_plots(Series.from_episode(episode)).axes if axes.get_ylabel() == "N")
    assert force.get_ylim()[0] == 0.0
    assert force.get_ylim()[1] > 1.1


def shown(episode: Episode) -> str:
    """The table at the end of a run as text."""
    console = Console(file=StringIO(), width=140)
    console.print(summary_table(numbers(episode), [Path("report.html")]))
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_thumbnails_are_averaged_not_cropped() -> None:
    image = np.zeros((100, 700, 3), np.uint8)
    image[:, ::2] = 200
    small = figure.shrink_image(image, 320)
    assert small.shape == (33, 233, 3)
    assert abs(float(small[..., 0].mean()) - 100) < 2


def test_moments_are_spread_and_hold_both_ends() -> None:
    assert figure.select_positions(41, 6) == [0, 8, 16, 24, 32, 40]
    assert figure.select_positions(3, 12) == [0, 1, 2]
    assert figure.select_positions(0, 6) == []


def test_figure4_shows_body_gels_and_images(tmp_path: Path) -> None:
    red, green = figure4_picture(tmp_path, 0.0), figure4_picture(tmp_path, 20e-3)
    clay = (np.array([0xC8, 0x62, 0x3A]) / 255).astype(np.float32)
    assert _pixels(red, clay) > 500  # the body is drawn, in its colour
    assert _pixels(green, clay) < _pixels(red, clay) / 2  # and leaves the window when it is elsewhere
    marker = np.array([1.0, 0.0, 1.0], np.float32)
    assert _pixels(red, marker) > 10_000  # the sensors' images, at five moments


def _pixels(picture: NDArray[np.float32], colour: NDArray[np.float32]) -> int:
    return int((np.abs(picture[..., :3] - colour).max(axis=-1) < 0.02).sum())


def figure4_picture(folder: Path, shift: float) -> NDArray[np.float32]:
    """Figure 4 of one made-up trial whose body stands `shift` beside the gels."""
    axis = np.arange(-4.5e-3, 5e-3, 1e-3)
    points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3) + np.array([shift, 0.0, 5e-3])
    height = np.zeros((80, 80), np.float32)
    magenta = np.broadcast_to(np.array([255, 0, 255], np.uint8), (48, 64, 3))
    poses = {"lower": Pose(), "upper": Pose(np.array([0, 0, 10e-3]), np.array([1.0, 0, 0, 0]))}
    moments = [
        Moment(k, dict.fromkeys(poses, magenta), dict.fromkeys(poses, height), poses, points.astype(np.float32), 1.0)
        for k in (0, 2, 4)
    ]
    reward = [-2.0, -1.0, 0.0, -1.0, -2.0]
    distance = [-value * 1e-3 for value in reward]
    trial = Trial(list(range(5)), reward, distance, distance, 7e-3, moments, 0.25e-3, (20e-3, 20e-3, 4e-3), 1e-3)
    path = folder / f"fig4-{shift}.png"
    draw_figure4({"squeeze": {"hybrid": trial}}, path)
    return imread(path)  # type: ignore[no-any-return]

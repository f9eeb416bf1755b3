"""Films of made-up episodes: frames, durations, and what is drawn where."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from tacsim.record.episode import Episode
from tacsim.report.film import FRAME_TIME, HEIGHT, LAST_FRAME_TIME, WIDTH, NoFilm, write_film
from tacsim.report.section import CLAY, Section, gel_states, section_of
from tests.tacsim.report.squeezed import GELS, squeezed, without_body


def count_clay(image: Image.Image | NDArray[np.uint8]) -> int:
    """Pixels in the colours of the body, in any light."""
    shown = np.asarray(image, np.float64)
    norms = np.linalg.norm(shown, axis=2)
    close = [(shown @ colour) / np.maximum(norms * np.linalg.norm(colour), 1e-9) > 0.998 for colour in CLAY]
    return int((np.logical_or(*close) & (norms > 60)).sum())


def test_gif_has_a_frame_a_step_and_repeats(tmp_path: Path) -> None:
    path = tmp_path / "a.gif"
    progress: list[tuple[int, int]] = []
    write_film(squeezed(), path, gels=GELS, on_frame=lambda *at: progress.append(at))
    with Image.open(path) as film:
        assert film.size == (WIDTH // 2, HEIGHT // 2)
        assert film.n_frames == 5  # type: ignore[attr-defined]
        assert film.info["loop"] == 0
        times, clay = [], []
        for k in range(5):
            film.seek(k)
            times.append(film.info["duration"])
            clay.append(count_clay(film.convert("RGB")))
    assert times == [FRAME_TIME] * 4 + [LAST_FRAME_TIME]
    assert min(clay) > 2000
    assert progress == [(k, 5) for k in range(1, 6)]


def test_gif_of_a_long_episode_has_at_most_300_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tacsim.report.film.MAX_FRAMES", 4)
    write_film(without_body(squeezed(steps=20)), tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames == 4  # type: ignore[attr-defined]


def test_mp4_has_a_frame_a_step(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    write_film(squeezed(), tmp_path / "a.mp4", gels=GELS)
    with av.open(str(tmp_path / "a.mp4")) as film:
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
        assert float(film.streams.video[0].average_rate) == 1000 / FRAME_TIME
    last = round(LAST_FRAME_TIME / FRAME_TIME)  # the last one is shown as long as in a GIF
    assert [frame.shape for frame in frames] == [(HEIGHT, WIDTH, 3)] * (4 + last)
    assert count_clay(frames[0]) > 8000


def test_episode_without_body_shows_pictures_and_curves(tmp_path: Path) -> None:
    write_film(without_body(squeezed()), tmp_path / "a.gif", gels=GELS)
    with Image.open(tmp_path / "a.gif") as film:
        film.seek(4)
        shown = np.asarray(film.convert("RGB"))
    assert (np.abs(shown.astype(int) - 100).max(axis=2) < 6).sum() > 10_000  # of the pictures' grey


@pytest.mark.parametrize(
    ("name", "episode", "words"),
    [("a.avi", squeezed(1), r"must end in \.gif or \.mp4"), ("a.gif", Episode(squeezed(1).meta), "no steps")],
)
def test_film_that_cannot_be_made(name: str, episode: Episode, words: str, tmp_path: Path) -> None:
    with pytest.raises(NoFilm, match=words):
        write_film(episode, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_mp4_without_its_package_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(NoFilm, match=r"pip install 'tacsim\[video\]'; or write a \.gif"):
        write_film(squeezed(1), tmp_path / "a.mp4")


def test_film_overwrites_nothing_and_leaves_no_half(tmp_path: Path) -> None:
    path = tmp_path / "a.gif"
    path.write_text("mine")
    with pytest.raises(FileExistsError):
        write_film(squeezed(1), path)
    assert path.read_text() == "mine"

    def fail(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_film(squeezed(1), tmp_path / "b.gif", on_frame=fail)
    assert not (tmp_path / "b.gif").exists()


def drawn(episode: Episode, at: int) -> tuple[Section, NDArray[np.uint8]]:
    section = section_of(episode, GELS, (500, 450))
    assert section is not None
    step = episode.steps[at]
    image = section.draw(step.body, gel_states(step, GELS, lambda sensor, frame: frame.surface))
    return section, np.asarray(image)


def test_section_shows_body_flatter_and_wider() -> None:
    episode = squeezed()
    extents = []
    for at in (0, 4):
        _, image = drawn(episode, at)
        values = np.linalg.norm(image.astype(float)[..., None, :] / 255 - CLAY / 255, axis=-1).min(axis=-1)
        rows, columns = np.nonzero(values < 0.25)
        extents.append((np.ptp(rows), np.ptp(columns)))
    (high, wide), (flat, broad) = extents
    assert 0.4 < flat / high < 0.62 and 1.15 < broad / wide < 1.35  # by half, and by a quarter


def test_section_shows_dent_in_gel() -> None:
    """In the middle the surface of the lower gel is drawn 0.5 mm lower than at its border."""
    section, image = drawn(squeezed(), 4)
    at = section.project(np.array([[0.0, section.cut, -0.25e-3], [8e-3, section.cut, -0.25e-3]]))
    (middle, border) = (image[round(v), round(u)] for u, v, _ in at)
    assert np.abs(border.astype(int) - np.array([172, 208, 226])).max() < 12  # gel
    assert np.abs(middle.astype(int) - np.array([172, 208, 226])).max() > 20  # the gel behind the section

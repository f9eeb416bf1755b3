"""Real group: tracking of the dots of a real gel in a film of a press, and the noise of its camera, with films of the
user.

The dots are found in the first frame, without contact, from that frame alone. The labels only give the number of dots
that were counted there by hand.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from itertools import islice
from pathlib import Path
from time import perf_counter, process_time
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from benchmarks.cases.real.labels import BadData, find
from benchmarks.harness.measure import Measurement, Timing
from benchmarks.harness.runner import Case
from tacsim.interface import Image
from tacsim.models.quantity import Config
from tacsim.record.episode import EpisodeError

CASE = "marker_film"
OWN = "films.yaml"
SHIPPED = Path(__file__).parents[2] / "references" / OWN
STILL = 3.0  # largest mean difference from the first frame of a gel at rest [grey levels]
REST_FRAMES = 8  # for the camera's noise
MAX_FRAMES = 2000


class Film(Config):
    """One film of a press; its first frame shows no contact."""

    name: str
    source: str = ""
    frames: Annotated[tuple[str, ...], Field(min_length=1)]  # a video or a folder of pictures, below the user's folder
    dots: Annotated[int, Field(ge=4)]  # whole ones in the first frame


class Films(Config):
    """Films of dotted gels."""

    films: Annotated[tuple[Film, ...], Field(min_length=1)]


def read_films(folder: Path) -> dict[Film, Path]:
    """The films below `folder`, by its own labels or the shipped ones. Raises ConfigError for labels with errors,
    BadData for a missing film that its own labels name."""
    from tacsim.config import load_model

    own = folder / OWN
    labels = load_model(Films, own if own.is_file() else SHIPPED)
    found = {}
    for film in labels.films:
        path = find(folder, film.frames) or (folder if folder.name in film.frames else None)
        if path is not None:
            found[film] = path
    if own.is_file() and len(found) < len(labels.films):
        missing = next(film for film in labels.films if film not in found)
        raise BadData(f"{own} names '{missing.name}', but {folder} has none of {', '.join(missing.frames)}")
    return found


def marker_film(film: Film, path: Path, repeat: int) -> list[Measurement]:
    """Dots tracked through a real press: share tracked to the end, jitter at rest, and the time of a frame."""
    from calibration.light.noise import NoiseUnknown, measure_noise
    from calibration.markers.dots import DotFinder, NoLattice, median_pitch
    from calibration.markers.flow import find_markers
    from calibration.markers.tracker import DotTracker

    frames = _read_film(path)
    first = next(frames, None)
    if first is None:
        raise BadData(f"{path}: a film without frames")
    try:
        _, radius = find_markers(first)
    except NoLattice as nothing:
        raise BadData(f"{path}: its first frame has no markers: {nothing}") from None
    find = DotFinder(radius)
    rest = find(first).centres
    tracker = DotTracker(rest, median_pitch(rest))
    samples, processor, still, moved = [], [], [], np.zeros_like(rest)
    always = np.ones(len(rest), dtype=np.bool_)
    fewest, out = len(rest), np.zeros_like(always)
    resting, at_rest = True, [first]
    for image in islice(frames, MAX_FRAMES):
        wall, cpu = perf_counter(), process_time()
        tracked = tracker(find(image).centres)
        samples.append(perf_counter() - wall)
        processor.append(process_time() - cpu)
        always &= tracked.visible
        fewest = min(fewest, int(tracked.visible.sum()))
        out |= ~tracked.visible & _is_cut(rest + tracked.displacement, radius, image)
        moved = np.where(np.abs(tracked.displacement) > np.abs(moved), tracked.displacement, moved)
        resting = resting and float(np.abs(image.astype(np.float32) - first).mean()) < STILL
        if resting:
            still.append(np.where(tracked.visible[:, None], tracked.displacement, np.nan))
            at_rest = [*at_rest, image][:REST_FRAMES]
    if not samples:
        raise BadData(f"{path}: a film of a single frame")
    tracked_dots = int(always.sum())
    figures = {
        "dots": float(len(rest)),
        "kept_percent": 100.0 * tracked_dots / film.dots,
        "worst_frame_percent": 100.0 * fewest / film.dots,
        "kept_in_picture_percent": 100.0 * tracked_dots / max(1, len(rest) - int((out & ~always).sum())),
        "motion_px": float(np.linalg.norm(moved, axis=1).max()),
        "radius_px": radius,
        "frames": len(samples) + 1.0,
    }
    if len(still) > 2:
        figures["jitter_px"] = float(np.nanmedian(np.nanstd(np.array(still), axis=0)))
    with suppress(NoiseUnknown):
        noise = measure_noise(at_rest)
        figures |= {f"noise_{name}": value for name, value in zip("rgb", noise.deviation, strict=True)}
        figures["noise_neighbours"] = float(np.mean(noise.neighbours))
    timing = Timing(tuple(samples), float(np.median(processor)))
    left = int((out & ~always).sum())
    note = f"{left} dots leave the picture" if left else ""
    lost = 100.0 * (1.0 - tracked_dots / film.dots)
    against = f"{film.dots} dots counted in the first frame"
    return [Measurement(timing, max(0.0, lost), "% lost", against, film.name, None, figures, note)]


def _is_cut(places: NDArray[np.float64], radius: float, image: Image) -> NDArray[np.bool_]:
    """(n,) True for dots at `places` (n, 2) that the border of the picture cuts."""
    rows, columns, _ = image.shape
    edge = np.array([columns - 1, rows - 1]) - radius
    return np.asarray(((places < radius) | (places > edge)).any(axis=1))


def _read_film(path: Path) -> Iterator[Image]:
    from tacsim.record.sources import folder_images, list_pictures, video_images

    try:
        yield from (folder_images(list_pictures(path)) if path.is_dir() else video_images(path))
    except EpisodeError as error:
        raise BadData(str(error)) from None


def cases(folder: Path) -> tuple[Case, ...]:
    """A case for each film below `folder`. Raises BadData, ConfigError."""
    return tuple(
        Case("real", CASE, "tacsim", "the film's own pixels", partial(marker_film, film, path), cpu=True)
        for film, path in read_films(folder).items()
    )

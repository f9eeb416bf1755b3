"""Reads recordings frame by frame: episodes, folders of pictures, videos."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import ArmState, EndOfEpisode, TactileFrame
from tacsim.record.episode import EpisodeError, EpisodeMeta
from tacsim.record.images import FORMATS, MAX_SIDE, image_size, read_image
from tacsim.record.reader import EpisodeFile

EPISODES = (".mcap",)
PICTURES = (".png", ".jpg", ".jpeg", ".bmp")
VIDEOS = (".avi", ".mp4", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg")

if TYPE_CHECKING:
    import cv2

T = TypeVar("T")


class Cursor(Generic[T]):
    """Random access to a recording that can only be read forwards: a smaller number starts it again."""

    def __init__(self, start: Callable[[], Iterator[T]], what: str) -> None:
        self._start, self._what = start, what
        self._items: Iterator[T] | None = None
        self._next = 0  # number of the next item
        self._current: T | None = None

    def at(self, number: int) -> T:
        """Raises EndOfEpisode when the recording is shorter, EpisodeError when it cannot be read."""
        if self._items is None or number < self._next - 1:
            self.close()
            self._items = self._start()
        while self._next <= number:
            try:
                self._current = next(self._items)
            except StopIteration:
                raise EndOfEpisode(f"{self._what} has {self._next} frames") from None
            except Exception:
                self.close()  # otherwise the generator that raised would look finished
                raise
            self._next += 1
        assert self._current is not None
        return self._current

    def close(self) -> None:
        """Closes the recording; `at` opens it again."""
        close = getattr(self._items, "close", None)
        if close is not None:  # a generator: runs its `finally`
            close()
        self._items, self._next, self._current = None, 0, None


def episode_meta(path: Path) -> EpisodeMeta:
    """The metadata of an episode. Raises EpisodeError."""
    with EpisodeFile(path, sensors=()) as file:
        return file.meta


def episode_frames(path: Path, sensor: str) -> Iterator[tuple[TactileFrame, float]]:
    """Frames of one sensor and the time of their steps [s, clock of the recording]."""
    with EpisodeFile(path, sensors=(sensor,)) as file:
        for step in file.steps():
            if sensor not in step.frames:
                raise EpisodeError(f"{path}: step {step.index} has no frame of sensor '{sensor}'")
            yield step.frames[sensor], step.time


def episode_states(path: Path, arm: str) -> Iterator[tuple[ArmState, float]]:
    """States of one arm and the time of their steps [s, clock of the recording]."""
    with EpisodeFile(path, sensors=()) as file:
        for step in file.steps():
            if arm not in step.arms:
                raise EpisodeError(f"{path}: step {step.index} has no state of arm '{arm}'")
            yield step.arms[arm], step.time


def only_or_named(names: list[str], name: str, path: Path, kind: str) -> str:
    """`name` if the recording has it, else its only one. Raises EpisodeError that lists the names."""
    if name in names:
        return name
    if len(names) == 1:
        return names[0]
    there = ", ".join(names) or "(none)"
    raise EpisodeError(f"{path}: no {kind} '{name}'; the recording has: {there}")


def list_pictures(folder: Path) -> list[Path]:
    """Pictures of a folder, "2.png" before "10.png". Raises EpisodeError for none, unreadable ones or several sizes."""
    paths = sorted((p for p in folder.iterdir() if p.suffix.lower() in PICTURES), key=_natural)
    if not paths:
        raise EpisodeError(f"{folder}: no pictures in this folder ({', '.join(PICTURES)})")
    rows, columns = image_size(paths[0])
    for path in paths[1:]:
        if image_size(path) != (rows, columns):
            other = image_size(path)
            raise EpisodeError(
                f"{path}: {other[1]} x {other[0]} pixels, but {paths[0].name} has {columns} x {rows}; "
                "all pictures of a folder must have one size"
            )
    return paths


def folder_images(paths: list[Path]) -> Iterator[NDArray[np.uint8]]:
    """(H, W, 3) RGB pictures, decoded one by one."""
    return (read_image(path) for path in paths)


def video_rate(path: Path) -> float | None:
    """Frames per second of a video; None when it does not contain that. Raises EpisodeError."""
    import cv2

    capture = _open_video(path)
    try:
        rate = capture.get(cv2.CAP_PROP_FPS)
    finally:
        capture.release()
    return rate if math.isfinite(rate) and 0 < rate <= 1000 else None


def video_images(path: Path) -> Iterator[NDArray[np.uint8]]:
    """(H, W, 3) RGB pictures of a video, decoded one by one. Raises EpisodeError, also for a video without frames."""
    import cv2

    capture = _open_video(path)
    try:
        count = 0
        while True:
            there, image = capture.read()
            if not there:
                break
            count += 1
            yield np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
        if count == 0:
            raise EpisodeError(f"{path}: a video without frames")
    finally:
        capture.release()


def _open_video(path: Path) -> cv2.VideoCapture:
    import cv2

    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)  # other backends may take a name for a device or a pipeline
    if not capture.isOpened():
        raise EpisodeError(f"{path}: no readable video, or one without frames")
    columns, rows = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
    if not (0 < columns <= MAX_SIDE and 0 < rows <= MAX_SIDE):
        capture.release()
        raise EpisodeError(f"{path}: {columns:.0f} x {rows:.0f} pixels; at most {MAX_SIDE} are allowed each way")
    return capture


def _natural(path: Path) -> list[str | int]:
    parts = re.split(r"([0-9]+)", path.name.lower())
    return [int(part) if number % 2 else part for number, part in enumerate(parts)]


def unknown_source(path: Path) -> EpisodeError:
    """The error for a path that is no recording."""
    if not path.exists():
        return EpisodeError(f"{path}: no such file or folder")
    return EpisodeError(
        f"{path}: no recording; give an episode ({', '.join(EPISODES)}), a folder of pictures ({', '.join(FORMATS)}) "
        f"or a video ({', '.join(VIDEOS)})"
    )

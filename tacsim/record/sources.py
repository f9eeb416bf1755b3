"""Reads recordings frame by frame: episodes, folders of pictures, videos; and the CSV record of a parallel gripper."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np

from tacsim.interface import ArmState, EndOfEpisode, GripperState, Image, Pose, TactileFrame
from tacsim.models.text import suggest_file, suggest_word
from tacsim.optics.picture_file import FORMATS, MAX_SIDE
from tacsim.record.episode import EpisodeError, EpisodeMeta
from tacsim.record.images import image_size, read_image
from tacsim.record.reader import EpisodeFile

EPISODES = (".mcap",)
PICTURES = (".png", ".jpg", ".jpeg", ".bmp")
OTHER_PICTURES = (".tif", ".tiff", ".webp", ".gif", ".exr", ".hdr", ".pgm", ".ppm", ".pnm", ".npy", ".raw", ".jp2")
NUMBER_COLUMNS = ("frame", "index")  # columns of a table with the numbers of its rows
SEPARATORS = ",;\t"
VIDEOS = (".avi", ".mp4", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg")

if TYPE_CHECKING:
    import cv2

T = TypeVar("T")


class Cursor(Generic[T]):
    """Random access to a recording that can only be read forwards: a smaller number reads it again from the start."""

    def __init__(self, start: Callable[[], Iterator[T]], what: str) -> None:
        self._start, self._what = start, what
        self._items: Iterator[T] | None = None
        self._next = 0  # number of the next item
        self._current: T | None = None

    def seek(self, number: int) -> T:
        """The item with this number. Raises EndOfEpisode if the recording is shorter, EpisodeError if it cannot be
        read.
        """
        if self._items is None or number < self._next - 1:
            self.close()
            self._items = self._start()
        while self._next <= number:
            try:
                self._current = next(self._items)
            except StopIteration:
                raise EndOfEpisode(f"{self._what} has {self._next} frames") from None
            except Exception:
                self.close()  # otherwise the generator that raised would seem finished
                raise
            self._next += 1
        assert self._current is not None
        return self._current

    def close(self) -> None:
        """Closes the recording; `seek` opens it again."""
        close = getattr(self._items, "close", None)
        if close is not None:  # a generator: runs its `finally`
            close()
        self._items, self._next, self._current = None, 0, None


def episode_meta(path: Path) -> EpisodeMeta:
    """The metadata of an episode. Raises EpisodeError."""
    with EpisodeFile(path) as file:
        return file.meta


def episode_frames(path: Path, sensor: str) -> Iterator[tuple[TactileFrame, float]]:
    """Frames of one sensor and the time of their steps [s, clock of the recording]."""
    with EpisodeFile(path) as file:
        for step in file.steps():
            if sensor not in step.frames:
                raise EpisodeError(f"{path}: step {step.index} has no frame of sensor '{sensor}'")
            yield step.frames[sensor], step.time


def episode_states(path: Path, arm: str) -> Iterator[tuple[ArmState, float]]:
    """States of one arm and the time of their steps [s, clock of the recording]."""
    with EpisodeFile(path) as file:
        for step in file.steps():
            if arm not in step.arms:
                raise EpisodeError(f"{path}: step {step.index} has no state of arm '{arm}'")
            yield step.arms[arm], step.time


def episode_gripper_states(path: Path, gripper: str) -> Iterator[tuple[GripperState, float]]:
    """States of one gripper and the time of their steps [s, clock of the recording]."""
    with EpisodeFile(path) as file:
        for step in file.steps():
            if gripper not in step.grippers:
                raise EpisodeError(f"{path}: step {step.index} has no state of gripper '{gripper}'")
            yield step.grippers[gripper], step.time


def select_name(names: list[str], name: str, path: Path, kind: str) -> str:
    """`name` if the recording has it, otherwise its only name. Raises EpisodeError that lists the names."""
    if name in names:
        return name
    if len(names) == 1:
        return names[0]
    wrong = f"no {kind} '{name}'{suggest_word(name, names)}" if name else f"which {kind}? Name one"
    raise EpisodeError(f"{path}: {wrong}; the recording has: {', '.join(names) or '(none)'}")


def visible_files(folder: Path, endings: Collection[str]) -> list[Path]:
    """Files of a folder with one of these endings, "2.png" before "10.png". Hidden files are left out: macOS writes
    "._2.png" next to "2.png" on disks with other file systems."""
    found = (path for path in folder.iterdir() if path.suffix.lower() in endings and not path.name.startswith("."))
    return sorted(found, key=_natural_order)


def list_pictures(folder: Path) -> list[Path]:
    """Pictures of a folder, "2.png" before "10.png". Raises EpisodeError for none, unreadable ones, more than 8 bits a
    channel, or several sizes."""
    paths = visible_files(folder, PICTURES)
    if not paths:
        raise EpisodeError(f"{folder}: no pictures in this folder ({', '.join(PICTURES)}){_suggest_files(folder)}")
    rows, columns = image_size(paths[0])
    for path in paths[1:]:
        if (other := image_size(path)) != (rows, columns):
            raise EpisodeError(
                f"{path}: {other[1]} x {other[0]} pixels, but {paths[0].name} has {columns} x {rows}; "
                "all pictures of a folder must have one size"
            )
    return paths


def _suggest_files(folder: Path) -> str:
    """Text with other files of a folder without pictures, which may explain the error."""
    if (bags := visible_files(folder, EPISODES)) and (folder / "metadata.yaml").is_file():
        return (
            f"; it is the folder of a ROS 2 bag ({bags[0].name}): replay it (tacsim run replay), or export its pictures"
        )
    if other := visible_files(folder, OTHER_PICTURES):
        return f", but {len(other)} like {other[0].name}; save them as PNG with 8 bits a channel"
    return ""


def folder_images(paths: list[Path]) -> Iterator[Image]:
    """(H, W, 3) RGB pictures, decoded one by one."""
    return (read_image(path) for path in paths)


def video_rate(path: Path) -> float | None:
    """Frames per second of a video; None if the file does not contain it. Raises EpisodeError."""
    import cv2

    with _open_video(path) as capture:
        rate = capture.get(cv2.CAP_PROP_FPS)
    return rate if math.isfinite(rate) and 0 < rate <= 1000 else None


def video_length(path: Path, expected: int) -> int:
    """Number of frames of a video, from its file; if that differs from `expected`, frames are counted, since some files
    have a wrong number. Raises EpisodeError."""
    import cv2

    with _open_video(path) as capture:
        if capture.get(cv2.CAP_PROP_FRAME_COUNT) == expected:
            return expected
        count = 0
        while capture.grab():
            count += 1
        return count


def video_images(path: Path) -> Iterator[Image]:
    """(H, W, 3) RGB pictures of a video, decoded one by one. Raises EpisodeError, also for a video without frames."""
    import cv2

    with _open_video(path) as capture:
        is_read, image = capture.read()
        if not is_read:
            raise EpisodeError(f"{path}: a video without frames")
        while is_read:
            yield np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
            is_read, image = capture.read()


@contextmanager
def _open_video(path: Path) -> Iterator[cv2.VideoCapture]:
    import cv2

    # other backends may interpret a name as a device or a pipeline
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        if not capture.isOpened():
            raise EpisodeError(f"{path}: no readable video, or one without frames")
        columns, rows = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
        if not (0 < columns <= MAX_SIDE and 0 < rows <= MAX_SIDE):
            raise EpisodeError(
                f"{path}: {columns:.0f} x {rows:.0f} pixels; at most {MAX_SIDE} are allowed along each axis"
            )
        yield capture
    finally:
        capture.release()


def _natural_order(path: Path) -> list[str | int]:
    parts = re.split(r"([0-9]+)", path.name.lower())
    return [int(part) if number % 2 else part for number, part in enumerate(parts)]


def unknown_source_error(path: Path) -> EpisodeError:
    """The error for a path that is no recording."""
    if not path.exists():
        return EpisodeError(f"{path}: no such file or folder{suggest_file(path, (*EPISODES, *VIDEOS))}")
    return EpisodeError(
        f"{path}: no recording; give an episode ({', '.join(EPISODES)}), a folder of pictures ({', '.join(FORMATS)}) "
        f"or a video ({', '.join(VIDEOS)})"
    )


def read_columns(path: Path, names: list[str]) -> list[tuple[float, ...]]:
    """The named columns of a CSV file, see `read_table`."""
    return read_table(path, names)[0]


def read_table(path: Path, names: list[str]) -> tuple[list[tuple[float, ...]], tuple[int, ...] | None]:
    """The named columns of a CSV file with a header, one tuple for each row, and the numbers of the rows, from a column
    of NUMBER_COLUMNS; None without such a column. Columns are separated by comma, semicolon or tab.

    Raises EpisodeError for a file that is missing or too large, a missing column, a value that is not a finite number,
    and numbers of rows that are not integers in increasing order.
    """
    max_header = 1 << 16  # [characters]
    max_bytes = 64 << 20  # [bytes]
    try:
        if path.stat().st_size > max_bytes:
            raise EpisodeError(f"{path}: {path.stat().st_size} bytes; at most {max_bytes} are read")
        with path.open(newline="", encoding="utf-8-sig") as file:
            head = file.readline(max_header)
            file.seek(0)
            separator = max(SEPARATORS, key=head.count)
            return _parse_rows(csv.DictReader(file, delimiter=separator, skipinitialspace=True), path, names)
    except (OSError, UnicodeDecodeError, csv.Error) as failure:
        raise EpisodeError(f"{path}: no readable CSV file: {failure}") from failure


def _parse_rows(
    reader: csv.DictReader[str], path: Path, names: list[str]
) -> tuple[list[tuple[float, ...]], tuple[int, ...] | None]:
    header = [column.strip() for column in reader.fieldnames or []]
    reader.fieldnames = header
    for name in names:
        if name not in header:
            raise EpisodeError(f"{path}: no column '{name}'; it has: {', '.join(header) or '(nothing)'}")
    rows: list[tuple[float, ...]] = []
    numbers: list[int] = []
    counter = next((column for column in header if column.lower() in NUMBER_COLUMNS), None)
    for row in reader:
        rows.append(tuple(_parse_number(row[name], path, reader.line_num, name) for name in names))
        if counter is not None:
            value = _parse_number(row[counter], path, reader.line_num, counter)
            if value != int(value) or value <= (numbers[-1] if numbers else -1):
                raise EpisodeError(
                    f"{path}:{reader.line_num}: {counter} {row[counter]} in row {len(rows) - 1}; each row needs a "
                    "whole number that is larger than the one before"
                )
            numbers.append(int(value))
    if not rows:
        raise EpisodeError(f"{path}: a header without rows")
    return rows, None if counter is None else tuple(numbers)


def _parse_number(text: str | None, path: Path, line: int, column: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise EpisodeError(f"{path}:{line}: column '{column}': '{text or ''}' is not a finite number")
    return value


def finger_states(
    rows: list[tuple[float, ...]], period: float, lower: bool, numbers: Sequence[int] | None = None
) -> list[ArmState]:
    """Arm states of one finger of a parallel gripper from rows (force [N],) or (force [N], opening [m]).

    The world frame is the gripper: origin midway between the fingers, z along the closing direction. Both fingers close
    by the same distance: the upper one is at z = +opening / 2 and faces down, the lower one at -opening / 2 and faces
    up. Without an opening the pose stays at the origin. A pressing force acts on the sensor towards its mount: wrench
    Fz = -force; the other five components were not measured and are 0. Twist: difference to the row before, over
    `period` [s] times the difference of the rows' `numbers`.
    """
    side = -1.0 if lower else 1.0
    quaternion = np.array([0.0, 0.0, 0.0, 1.0] if lower else [1.0, 0.0, 0.0, 0.0])  # half a turn about x
    place = [side * opening[0] / 2.0 if opening else 0.0 for _, *opening in rows]
    counted = np.arange(len(rows)) if numbers is None else np.asarray(numbers)
    speed = np.diff(place, prepend=place[0]) / (period * np.diff(counted, prepend=counted[0] - 1))
    return [
        ArmState(
            pose=Pose(np.array([0.0, 0.0, place[k]]), quaternion),
            twist=np.array([0.0, 0.0, speed[k], 0.0, 0.0, 0.0]),
            wrench=np.array([0.0, 0.0, -force, 0.0, 0.0, 0.0]),
            joints=None,
            time=k * period,
        )
        for k, (force, *_) in enumerate(rows)
    ]

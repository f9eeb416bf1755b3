"""Folders and videos that are played in place of a camera."""

from __future__ import annotations

import re
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from robot.camera.camera import Camera
from robot.camera.picture import WrongSource
from tacsim.interface import EndOfEpisode, TactileFrame
from tests.robot.camera.mocked import WAIT, config

pytestmark = pytest.mark.usefixtures("nothing_is_left")


def write_pictures(folder: Path, count: int) -> list[Path]:
    paths = [folder / f"{number}.png" for number in range(count)]
    for number, path in enumerate(paths):
        Image.fromarray(np.full((24, 32, 3), 10 * number, dtype=np.uint8)).save(path)
    return paths


def played(source: object, **options: object) -> Camera:
    return Camera(config(source, **{"width": 32, "height": 24, "fps": 20.0, "max_age": 10.0, **options}), "left")


def read_all(camera: Camera, end: type[Exception], text: str) -> dict[int, TactileFrame]:
    """Frames by index, until `end` is raised with `text`."""
    seen: dict[int, TactileFrame] = {}
    try:
        while True:
            frame = camera.read(WAIT)
            seen[frame.index] = frame
            time.sleep(2e-3)
    except end as reason:
        if re.search(text, str(reason)) is None:
            raise
        return seen


def test_played_folder_ends_after_last_picture(tmp_path: Path) -> None:
    write_pictures(tmp_path, 12)
    with played(tmp_path) as camera:
        seen = read_all(camera, EndOfEpisode, "no more pictures")
    assert set(seen) <= set(range(12)) and len(seen) > 3
    assert all((frame.image == 10 * index).all() for index, frame in seen.items())
    times = [seen[index].time for index in sorted(seen)]
    assert times[-1] - times[0] > 0.05 * (max(seen) - min(seen) - 1) - 1e-3  # the first may have come late


def test_played_video_ends_after_last_picture(tmp_path: Path) -> None:
    import cv2

    path = tmp_path / "v.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 20.0, (32, 24))
    for number in range(8):
        writer.write(np.full((24, 32, 3), (10 * number, 0, 0), dtype=np.uint8))
    writer.release()
    with played(path, fps=1.0) as camera:
        image = camera.read(WAIT).image
        assert image[0, 0, 0] == 0 and image[0, 0, 2] % 10 <= 1  # BGR in the file, RGB here
        read_all(camera, EndOfEpisode, "no more pictures")
    assert camera.status.frames == 8
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 100])
    with pytest.raises(WrongSource, match="no readable video"):
        played(path)


def test_played_slow_folder_closes_quickly(tmp_path: Path) -> None:
    write_pictures(tmp_path, 2)
    camera = played(tmp_path, fps=0.001)
    begin = time.monotonic()
    camera.close()
    assert time.monotonic() - begin < WAIT  # the next picture is due in a quarter of an hour


def test_played_invalid_folder_raises(tmp_path: Path) -> None:
    with pytest.raises(WrongSource, match="no pictures in this folder"):
        played(tmp_path)
    paths = write_pictures(tmp_path, 3)
    with pytest.raises(WrongSource, match="frames are 32 x 24 px, expected 64 x 48"):
        played(tmp_path, width=64, height=48)
    paths[1].write_bytes(b"no picture")
    with pytest.raises(WrongSource, match=r"1\.png"):
        played(tmp_path)
    paths[1].write_bytes(b"")
    with pytest.raises(WrongSource, match=r"1\.png"):
        played(tmp_path)
    with pytest.raises(WrongSource, match="no such file or folder"):
        played(tmp_path / "nothing")
    with pytest.raises(WrongSource, match="no readable video"):
        played(paths[1])


def test_played_damaged_picture_ends_folder(tmp_path: Path) -> None:
    paths = write_pictures(tmp_path, 3)
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)).save(paths[1])
    paths[1].write_bytes(paths[1].read_bytes()[:-800])
    with played(tmp_path) as camera:
        seen = read_all(camera, WrongSource, r"1\.png")
    assert set(seen) == {0}

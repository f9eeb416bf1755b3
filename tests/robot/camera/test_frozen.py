"""A camera that sends the same picture forever has frozen, at any frame rate."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from robot.camera.camera import Camera, StaleFrame
from robot.mock.camera.camera import MockCamera
from tests.promises import Record
from tests.robot.camera.mocked import HOST, WAIT, newer
from tests.robot.camera.mocked import config as mock_config
from tests.robot.camera.servers import Server, config, encoded, films, seen
from tests.robot.waiting import until

pytestmark = pytest.mark.usefixtures("nothing_is_left", "patient")
SAME = "has shown the same picture for"


def with_clock(image: np.ndarray, number: int) -> np.ndarray:
    """The picture with a small clock in its corner, one digit of which has changed."""
    image = image.copy()
    image[2:6, 2:5] = 255 * (np.arange(12).reshape(4, 3, 1) >> (number % 4) & 1)
    return image


def covered(number: int) -> np.ndarray:
    """A lens that is covered: black, but for some hot pixels."""
    image = np.zeros((480, 640, 3), dtype=np.uint8)
    image.reshape(-1)[np.random.default_rng(number).integers(0, image.size, 20)] = 30
    return image


@pytest.mark.promise(11)
def test_camera_frozen_picture_is_reported_as_stale(server: Server, figure: Record) -> None:
    frozen = threading.Event()

    def picture(number: int) -> bytes:
        return encoded(seen(100, 7 if frozen.is_set() else number + 100))

    server.talk = films(server, picture)
    with Camera(config(server.url, max_age=0.2), "left", connect_timeout=WAIT) as camera:
        newer(camera, camera.read(WAIT))
        frozen.set()
        began = time.monotonic()
        until(lambda: camera.status.error is not None)
        figure("frozen picture reported (max_age 200 ms)", 1e3 * (time.monotonic() - began), "ms", at_most=300)
        before, status = camera.status.frames, camera.status
        until(lambda: camera.status.repeated > status.repeated + 20)
        figure("stale frames delivered, or passed as new", camera.status.frames - before)
        assert camera.status.frames == before
        assert status.open and status.dropped == status.damaged == status.reopened == 0
        with pytest.raises(
            StaleFrame, match=rf"limit 200 ms; sensor 'left': {server.url[:12]}.* {SAME} .*repeats: true"
        ):
            camera.read(0.0)
        frozen.clear()
        camera.read(WAIT)
        until(lambda: camera.status.error is None)


@pytest.mark.parametrize("kind", ["with a clock", "covered"])
def test_camera_nearly_equal_picture_counts_as_repeat(server: Server, kind: str) -> None:
    still = np.tile(seen(100, 7, (60, 64)), (8, 10, 1))

    def picture(number: int) -> bytes:
        return encoded(with_clock(still, number) if kind == "with a clock" else covered(number))

    server.talk = films(server, picture)
    large = config(server.url, max_age=0.2, width=640, height=480)
    with Camera(large, "left", connect_timeout=WAIT) as camera:
        until(lambda: SAME in (camera.status.error or ""))
        assert camera.status.frames == 1 and camera.status.repeated > 1


def test_camera_short_repeats_are_skipped(server: Server) -> None:
    """As of a server whose sensor is slower, or of a driver in low light: only each third frame is new."""
    server.talk = films(server, lambda number: encoded(seen(100, number // 3)), every=0.003)
    with Camera(config(server.url, max_age=10.0), "left", connect_timeout=WAIT) as camera:
        until(lambda: camera.status.frames > 10)
        status, frame = camera.status, camera.read(WAIT)
    assert status.repeated >= 18 and status.dropped == 0 and status.error is None
    assert frame.index >= status.frames - 1


def test_camera_frozen_after_reopening_stays_stale(server: Server) -> None:
    same = encoded(seen(100, 7))

    def three(number: int) -> bytes:
        if number == 3:
            raise ConnectionError  # ends the conversation
        return same

    server.talk = films(server, three)
    with Camera(config(server.url, max_age=0.2), "left", connect_timeout=WAIT) as camera:
        until(lambda: camera.status.reopened >= 2)
        assert camera.status.frames == 1
        with pytest.raises(StaleFrame):
            camera.read(0.0)


def test_camera_repeats_true_accepts_equal_pictures(server: Server) -> None:
    same = encoded(seen(100, 7))
    server.talk = films(server, lambda number: same)
    with Camera(config(server.url, repeats=True), "left", connect_timeout=WAIT) as camera:
        until(lambda: camera.status.frames > 10)
        assert camera.status.repeated == 0


def test_camera_folder_accepts_equal_pictures(tmp_path: Path) -> None:
    for number in range(4):
        Image.fromarray(seen(100, 7)).save(tmp_path / f"{number}.png")
    with Camera(config(tmp_path.as_posix(), fps=100.0), "left", connect_timeout=WAIT) as camera:
        until(lambda: camera.status.frames == 4)


@pytest.mark.parametrize("stamped", [True, False])
def test_mock_camera_frozen_raises_stale_frame(stamped: bool) -> None:
    with (
        MockCamera(host=HOST, stamped=stamped) as mock,
        Camera(mock_config(mock.url, stamped=stamped, max_age=0.3), "left", connect_timeout=WAIT) as camera,
    ):
        mock.push(
            np.full((240, 320, 3), 120, dtype=np.uint8)
        )  # at rest its pictures differ by noise, or by their stamps
        first = newer(camera, camera.read(WAIT))
        for _ in range(5):
            first = newer(camera, first)
        mock.freeze(True)
        until(lambda: SAME in (camera.status.error or ""))
        assert mock.state().freeze
        with pytest.raises(StaleFrame):
            camera.read(0.0)
        mock.freeze(False)
        assert newer(camera, first).time > first.time

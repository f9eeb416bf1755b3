"""Damaged JPEGs: what lost packets, broken senders and full buffers make of a picture."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest

from robot.camera import mjpeg
from robot.camera.camera import Camera, StaleFrame
from robot.camera.picture import DamagedFrame, WrongSource, decode_jpeg
from robot.mock.camera.camera import MockCamera
from tests.promises import Record
from tests.robot.camera.mocked import HOST, WAIT, newer, stamped
from tests.robot.camera.servers import Server, config, encoded, films, seen
from tests.robot.waiting import until

SIZE = (240, 320)
END = b"\xff\xd9"
WHOLE = encoded(np.add(seen(90, 7, SIZE), np.arange(320)[:, None] // 4, dtype=np.uint8, casting="unsafe"))
SCAN = WHOLE.index(b"\xff\xda") + 14  # where the header ends
HALF = (SCAN + len(WHOLE)) // 2


def test_decode_jpeg_complete_picture_passes() -> None:
    assert decode_jpeg(WHOLE, SIZE, "here").shape == (240, 320, 3)


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "not a JPEG"),
        (b"no picture", "not a JPEG"),
        (WHOLE[:HALF], "Premature end"),
        (WHOLE[:-2], "Premature end"),
        (WHOLE[:HALF] + END, "premature end"),
        (WHOLE[:HALF] + bytes(len(WHOLE) - HALF - 2) + END, "premature end|extraneous"),
        (WHOLE[:HALF] + WHOLE[HALF + 900 :], "premature end"),
        (WHOLE[:-2] + bytes(100) + END, r"\d\d extraneous bytes"),
    ],
    ids=["nothing", "no picture", "cut", "no end marker", "cut, with end marker", "zeros", "hole", "more than padding"],
)
def test_decode_jpeg_damage_raises(data: bytes, why: str) -> None:
    with pytest.raises(DamagedFrame, match=f"here: a damaged picture .*({why})"):
        decode_jpeg(data, SIZE, "here")


@pytest.mark.promise(11)
def test_decode_jpeg_lost_packet_raises(figure: Record) -> None:
    """A USB packet or a TCP segment that is missing from the middle."""
    rng, passed = np.random.default_rng(0), 0
    for size in (188, 512, 944, 1448, 3060):
        for start in rng.integers(SCAN, len(WHOLE) - size - 2, 40):
            try:
                decode_jpeg(WHOLE[:start] + WHOLE[start + size :], SIZE, "here")
            except DamagedFrame:
                continue
            passed += 1
    figure("of 200 pictures with a lost packet, delivered", passed)
    assert passed == 0


def test_decode_jpeg_flipped_bytes_mostly_raise() -> None:
    """A flipped byte that gives another valid picture cannot be seen by any decoder; the more are flipped, the fewer
    pass."""
    rng = np.random.default_rng(0)
    passed = {1: 0, 20: 0}
    for count in passed:
        for _ in range(100):
            data = bytearray(WHOLE)
            for place in rng.integers(SCAN, len(WHOLE) - 2, count):
                data[place] ^= int(rng.integers(1, 256))
            try:
                decode_jpeg(bytes(data), SIZE, "here")
            except DamagedFrame:
                continue
            passed[count] += 1
    assert passed[1] <= 90 and passed[20] <= 20


def test_decode_jpeg_random_bytes_raise_damaged_frame() -> None:
    rng = np.random.default_rng(1)
    for _ in range(300):
        data = bytearray(WHOLE[: rng.integers(len(WHOLE))] if rng.random() < 0.3 else WHOLE)
        for place in rng.integers(0, min(SCAN + 20, len(data)) or 1, rng.integers(1, 10)):
            data[place : place + 1] = rng.bytes(1)
        with suppress(DamagedFrame, WrongSource):
            assert decode_jpeg(bytes(data), SIZE, "here").shape == (*SIZE, 3)


def test_decode_jpeg_padding_passes() -> None:
    """Some pad each picture with a few bytes, before the end or after it."""
    whole = decode_jpeg(WHOLE, SIZE, "here")
    for data in (WHOLE + bytes(500), WHOLE[:-2] + bytes(9) + END):
        np.testing.assert_array_equal(decode_jpeg(data, SIZE, "here"), whole)


def test_decode_jpeg_wrong_size_raises_wrong_source() -> None:
    with pytest.raises(WrongSource, match="frames are 320 x 240 px, expected 64 x 48"):
        decode_jpeg(WHOLE, (48, 64), "here")


@pytest.mark.promise(11)
def test_camera_damaged_pictures_are_dropped_and_reported(
    server: Server, figure: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mjpeg, "READ_TIMEOUT", 2 * WAIT)
    broken = False

    def picture(number: int) -> bytes:
        data = encoded(seen(100, number))
        return data[: len(data) * 2 // 3] + END if broken else data

    server.talk = films(server, picture)
    with Camera(config(server.url, max_age=0.2), "left", connect_timeout=WAIT) as camera:
        newer(camera, camera.read(WAIT))
        broken = True
        until(lambda: camera.status.damaged > 0)
        before = camera.status
        until(lambda: camera.status.damaged > before.damaged + 10)
        figure("damaged pictures delivered", camera.status.frames - before.frames)
        assert camera.status.frames == before.frames and camera.status.open
        until(lambda: (camera.status.age or 0.0) > 0.25)
        with pytest.raises(StaleFrame, match=r"sensor 'left': .*a damaged picture .*cable"):
            camera.read(0.0)
        broken = False
        camera.read(WAIT)


@pytest.mark.parametrize("fault", ["cut", "flip"])
def test_mock_camera_damaged_pictures_are_counted(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mjpeg, "READ_TIMEOUT", 2 * WAIT)
    with MockCamera(host=HOST) as mock, Camera(stamped(mock), "left", connect_timeout=WAIT) as camera:
        getattr(mock, fault)(True if fault == "cut" else 500)
        until(lambda: camera.status.damaged >= 5)

"""Streams over HTTP: many kinds of servers, also wrong, slow and silent ones."""

from __future__ import annotations

import io
import socket
import struct
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from PIL import Image

from robot.camera import mjpeg
from robot.camera.camera import Camera
from robot.camera.mjpeg import MjpegCapture
from robot.camera.picture import WrongSource
from robot.common import stamp
from robot.errors import DeviceNotConnectedError
from tests.robot.camera.servers import HOST, OK, STREAM, Server, Talk, config, jpeg, length, part, says


def forever(server: Server, first: bytes, again: bytes, every: float = 0.0) -> Talk:
    def talk(client: socket.socket) -> None:
        client.settimeout(5.0)
        client.sendall(first)
        while True:
            client.sendall(again)
            server.wait(every)

    return talk


def chunked(data: bytes) -> bytes:
    return b"%x\r\n" % len(data) + data + b"\r\n"


WHOLE = jpeg()
STREAMS = {
    "with lengths": [
        STREAM,
        *(part(jpeg(10 * k), b"Content-Type: image/jpeg", length(jpeg(10 * k))) for k in range(4)),
    ],
    "without lengths": [STREAM, *(part(jpeg(10 * k), b"Content-Type: image/jpeg") for k in range(4)), b"--here\r\n"],
    "byte by byte": [bytes([byte]) for k in range(4) for byte in (STREAM if k == 0 else b"") + part(jpeg(10 * k))]
    + [b"--here\r\n"],
    "chunked": [STREAM.replace(b"\r\n\r\n", b"\r\nTransfer-Encoding: chunked\r\n\r\n")]
    + [chunked(part(jpeg(10 * k), length(jpeg(10 * k)))) for k in range(4)],
    "dashes in the boundary, quoted": [STREAM.replace(b"=here", b'="--here"')]
    + [part(jpeg(10 * k), length(jpeg(10 * k))) for k in range(4)],
    "with junk before": [STREAM, b"hello\r\n\r\n", *(part(jpeg(10 * k), length(jpeg(10 * k))) for k in range(4))],
}


def stream(boundary: bytes, line: bytes, newline: bytes = b"\r\n", lengths: bool = False) -> list[bytes]:
    """A server that states `boundary` in its header and puts `line` between its pictures."""
    header = OK + b"Content-Type: multipart/x-mixed-replace; boundary=" + boundary + b"\r\n\r\n"
    parts = []
    for k in range(4):
        lines = [line, b"Content-Type: image/jpeg", *([length(jpeg(10 * k))] if lengths else []), b"", b""]
        parts.append(newline.join(lines) + jpeg(10 * k) + newline)
    return [header, *parts, line + b"--" + newline]


STREAMS |= {
    "two dashes stated, four sent": stream(b"--here", b"----here"),
    "two dashes stated, four sent, with lengths": stream(b"--here", b"----here", lengths=True),
    "two dashes stated, two sent": stream(b"--here", b"--here"),
    "no dashes sent": stream(b"here", b"here"),
    "quoted, with blanks and signs": stream(b'"a b=c:/?"', b"--a b=c:/?"),
    "signs that should be quoted": stream(b"a=b", b"--a=b"),
    "line feeds alone": stream(b"here", b"--here", b"\n"),
    "line feeds alone, with lengths": stream(b"here", b"--here", b"\n", lengths=True),
    "a short boundary": stream(b"f", b"--f"),
}


@pytest.mark.parametrize("name", STREAMS)
def test_mjpeg_server_variants_are_read(server: Server, name: str) -> None:
    server.talk = says(*STREAMS[name])
    stream = MjpegCapture(config(server.url), "left")
    try:
        pictures = [stream.read() for _ in range(4)]
        assert [round(float(picture.image.mean()), -1) for picture in pictures] == [0, 10, 20, 30]
        assert all(picture.exposure is None and picture.image.shape == (48, 64, 3) for picture in pictures)
        with pytest.raises(ConnectionError):
            stream.read()
    finally:
        stream.close()
    assert server.requests[0].startswith(b"GET /?action=stream HTTP/1.1\r\nHost: " + HOST.encode())


def huge() -> bytes:
    """A small JPEG that says it is 60000 x 60000 px."""
    at = WHOLE.index(b"\xff\xc0")
    return WHOLE[: at + 5] + struct.pack(">HH", 60000, 60000) + WHOLE[at + 9 :]


LIES = {
    "a page": (OK + b"Content-Type: text/html\r\n\r\n<html>hello</html>", "content of type text/html"),
    "a wrong path": (b"HTTP/1.1 404 Not Found\r\n\r\n", "HTTP status 404 Not Found; check the path"),
    "another place": (b"HTTP/1.1 302 Found\r\nLocation: http://other/\r\n\r\n", "HTTP status 302"),
    "no HTTP": (b"SSH-2.0-OpenSSH_9.6\r\n", "no HTTP answer"),
    "no boundary": (OK + b"Content-Type: multipart/x-mixed-replace\r\n\r\n", "without boundary"),
    "too long a line": (OK + b"X: " + b"a" * 100_000 + b"\r\n\r\n", "no HTTP answer"),
    "a huge length": (STREAM + part(b"", b"Content-Length: 99999999999"), "a picture of 99999999999 bytes"),
    "a huge picture": (STREAM + part(huge(), length(huge())), "frames are 60000 x 60000 px, expected 64 x 48"),
    "a long line in a part": (STREAM + b"--here\r\n" + b"a" * 10_000, "a line of more than 8192 bytes"),
    "a long header of a part": (STREAM + b"--here\r\n" + b"X: 1\r\n" * 100, "a part with more than 64 header lines"),
    "another size": (STREAM + part(jpeg(shape=(96, 64))), "frames are 64 x 96 px, expected 64 x 48"),
}


@pytest.mark.parametrize("name", LIES)
def test_mjpeg_wrong_server_raises_wrong_source(server: Server, name: str) -> None:
    sent, text = LIES[name]
    server.talk = forever(server, sent + b"\r\n--here\r\n", b"", every=60.0)
    begin = time.monotonic()
    with pytest.raises(WrongSource, match=text) as caught:
        Camera(config(server.url), "left", connect_timeout=60.0)
    assert time.monotonic() - begin < 30.0
    assert server.url in str(caught.value) and "'left'" in str(caught.value)


@pytest.mark.parametrize(
    ("first", "again", "text"),
    [
        (OK, b"X: more\r\n", "no HTTP answer"),
        (STREAM, b"junk\r\n" * 100, "no boundary within"),
        (STREAM + b"--here\r\n\r\n", b"x" * 1000, "no end of the picture"),
    ],
)
def test_mjpeg_endless_header_raises_wrong_source(server: Server, first: bytes, again: bytes, text: str) -> None:
    server.talk = forever(server, first, again)
    with pytest.raises(WrongSource, match=text):
        Camera(config(server.url), "left", connect_timeout=60.0)


DRIPS = {
    "says nothing": (b"", b""),
    "drips the status": (b"", b"H"),
    "drips the header": (OK, b"X: y\r\n"),
    "says no more after its header": (STREAM, b""),
    "drips junk": (STREAM, b"x"),
    "drips a picture": (STREAM + b"--here\r\nContent-Length: 2000\r\n\r\n", b"x"),
    "drips a picture without length": (STREAM + b"--here\r\n\r\n", b"x"),
}


@pytest.mark.slow
def test_mjpeg_slow_or_silent_server_times_out() -> None:
    """One byte now and then keeps a plain socket's time-out from passing; the deadline passes all the same. Side by
    side, because each takes its two seconds."""

    def refused(name: str) -> int:
        server = Server()
        try:
            server.talk = forever(server, *DRIPS[name], every=0.2)
            begin = time.monotonic()
            with pytest.raises(DeviceNotConnectedError, match=r"no picture from .* within 2 s"):
                Camera(config(server.url), "left", connect_timeout=2.0)
            assert time.monotonic() - begin < 30.0
            return len(server.requests)
        finally:
            server.close()

    with ThreadPoolExecutor(len(DRIPS)) as pool:
        requests = dict(zip(DRIPS, pool.map(refused, DRIPS), strict=True))
    assert min(requests.values()) >= 2, requests  # it was tried again


@pytest.mark.slow
@pytest.mark.promise(9)
def test_mjpeg_unanswered_connection_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """A listener with a full queue drops connections: no answer, no refusal."""
    with socket.socket() as hole:
        hole.bind((HOST, 0))
        hole.listen(0)
        fillers = [socket.socket() for _ in range(4)]
        try:
            for filler in fillers:
                filler.setblocking(False)
                filler.connect_ex(hole.getsockname())
            begin = time.monotonic()
            with pytest.raises(DeviceNotConnectedError, match="timed out"):
                Camera(config(f"http://{HOST}:{hole.getsockname()[1]}/"), "left", connect_timeout=1.5)
            assert time.monotonic() - begin < 30.0
        finally:
            for filler in fillers:
                filler.close()


def test_mjpeg_invalid_pictures_are_skipped(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mjpeg, "READ_TIMEOUT", 60.0)  # a busy machine is no stall
    broken = [b"no picture", b"", WHOLE[:100], WHOLE[: len(WHOLE) // 2], WHOLE[:-20] + bytes(20)]
    server.talk = forever(server, STREAM + b"".join(part(data, length(data)) for data in broken[:4]), part(WHOLE), 0.02)
    with Camera(config(server.url), "left", connect_timeout=20.0) as camera:
        assert abs(float(camera.read(20.0).image.mean()) - 100) < 2
        assert camera.status.damaged == 4 and camera.status.reopened == 0


@pytest.mark.promise(11)
def test_mjpeg_repeated_frame_keeps_index(server: Server) -> None:
    """Some servers greet a new client with the last frame they have: after a stall it is old news."""
    mark = stamp.Stamp(frame=7, image=0, clock=time.monotonic_ns() // 1000)
    image = stamp.draw(np.full((48, 64, 3), 100, dtype=np.uint8), mark)
    data = io.BytesIO()
    Image.fromarray(image).save(data, "JPEG", quality=95)
    server.talk = says(STREAM, part(data.getvalue(), length(data.getvalue())) * 3)
    with Camera(config(server.url, stamped=True, max_age=60.0), "left", connect_timeout=20.0) as camera:
        first = camera.read(20.0)
        deadline = time.monotonic() + 20.0
        while camera.status.reopened < 2 and time.monotonic() < deadline:
            time.sleep(0.005)
        assert camera.status.reopened >= 2 and camera.status.frames == 1 and camera.read(1.0) is first

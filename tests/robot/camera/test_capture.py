"""Sources that are none, or wrong: servers that lie, drip or say nothing, and UVC cameras that do not keep settings."""

from __future__ import annotations

import io
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from PIL import Image

from robot.camera import capture, mjpeg
from robot.camera.camera import Camera
from robot.camera.capture import PlayedCapture, UvcCapture, source_kind
from robot.camera.mjpeg import MjpegCapture
from robot.camera.picture import WrongSource
from robot.common import stamp
from robot.errors import DeviceNotConnectedError
from tacsim.models.hardware import CameraSensorConfig

HOST = f"127.22.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"
OK = b"HTTP/1.1 200 OK\r\n"
STREAM = OK + b"Content-Type: multipart/x-mixed-replace;boundary=here\r\n\r\n"


def config(source: str, **options: object) -> CameraSensorConfig:
    known: dict[str, object] = {"width": 64, "height": 48, "fps": 30.0, "max_age": 10.0}
    return CameraSensorConfig.model_validate({"driver": "camera", "source": source, **known, **options})


def jpeg(value: int = 100, shape: tuple[int, int] = (48, 64)) -> bytes:
    data = io.BytesIO()
    Image.fromarray(np.full((*shape, 3), value, dtype=np.uint8)).save(data, "JPEG", quality=95)
    return data.getvalue()


Talk = Callable[[socket.socket], None]


class Server:
    """Answers each client in a thread with whatever `talk` sends."""

    def __init__(self) -> None:
        self._listening = socket.create_server((HOST, 0))
        self._closed = threading.Event()
        self.talk: Talk = lambda client: None
        self.url = f"http://{HOST}:{self._listening.getsockname()[1]}/?action=stream"
        self.requests: list[bytes] = []
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._threads[0].start()

    def _accept(self) -> None:
        while not self._closed.is_set():
            try:
                client, _ = self._listening.accept()
            except OSError:
                return
            self._threads.append(threading.Thread(target=self._serve, args=(client,), daemon=True))
            self._threads[-1].start()

    def _serve(self, client: socket.socket) -> None:
        with client:
            client.settimeout(0.05)
            try:
                self.requests.append(client.recv(4096))
                self.talk(client)
            except OSError:
                return

    def wait(self, seconds: float) -> None:
        """Sleeps; ends the conversation when the server is closed."""
        if self._closed.wait(seconds):
            raise ConnectionError

    def close(self) -> None:
        self._closed.set()
        self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        for thread in self._threads:
            thread.join(10.0)


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    yield server
    server.close()


def says(*parts: bytes) -> Talk:
    def talk(client: socket.socket) -> None:
        client.settimeout(5.0)
        for part in parts:
            client.sendall(part)

    return talk


def forever(server: Server, first: bytes, again: bytes, every: float = 0.0) -> Talk:
    def talk(client: socket.socket) -> None:
        client.settimeout(5.0)
        client.sendall(first)
        while True:
            client.sendall(again)
            server.wait(every)

    return talk


def part(data: bytes, *lines: bytes) -> bytes:
    return b"--here\r\n" + b"".join(line + b"\r\n" for line in lines) + b"\r\n" + data + b"\r\n"


def length(data: bytes) -> bytes:
    return b"Content-Length: %d" % len(data)


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


@pytest.mark.parametrize("name", STREAMS)
def test_streams_of_many_kinds_of_servers(server: Server, name: str) -> None:
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
    "a huge picture": (STREAM + part(huge(), length(huge())), "3600000000 pixels.*; expected are 64 x 48"),
    "a long line in a part": (STREAM + b"--here\r\n" + b"a" * 10_000, "a line of more than 8192 bytes"),
    "a long header of a part": (STREAM + b"--here\r\n" + b"X: 1\r\n" * 100, "a part with more than 64 header lines"),
    "another size": (STREAM + part(jpeg(shape=(96, 64))), "frames are 64 x 96 px, expected are 64 x 48"),
}


@pytest.mark.parametrize("name", LIES)
def test_servers_that_are_no_camera_are_refused_at_once(server: Server, name: str) -> None:
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
def test_servers_without_an_end_are_refused(server: Server, first: bytes, again: bytes, text: str) -> None:
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


def test_servers_that_drip_or_say_nothing() -> None:
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


@pytest.mark.promise(9)
def test_a_black_hole(monkeypatch: pytest.MonkeyPatch) -> None:
    """A listener whose queue is full drops what knocks: nobody answers, nobody refuses."""
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


def test_pictures_that_are_none_are_passed_over(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mjpeg, "READ_TIMEOUT", 60.0)  # a busy machine is no stall
    broken = [b"no picture", b"", WHOLE[:100], WHOLE[: len(WHOLE) // 2], WHOLE[:-20] + bytes(20)]
    server.talk = forever(server, STREAM + b"".join(part(data, length(data)) for data in broken[:4]), part(WHOLE), 0.02)
    with Camera(config(server.url), "left", connect_timeout=20.0) as camera:
        assert abs(float(camera.read(20.0).image.mean()) - 100) < 2
        assert camera.status.damaged == 4 and camera.status.reopened == 0


@pytest.mark.promise(11)
def test_a_frame_that_is_sent_again_is_no_new_one(server: Server) -> None:
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


@pytest.mark.promise(11)
@pytest.mark.parametrize(
    ("source", "text"),
    [
        ("0", "is an index; indices change"),
        ("-1", "is an index"),
        ("/dev/video2", r"is an index; .*/dev/v4l/by-id/"),
        ("rtsp://127.0.0.1/", "only http:// streams"),
        ("https://127.0.0.1/", "only http:// streams"),
        ("ftp://127.0.0.1/", "only http:// streams"),
        ("/nowhere/at/all", "no such file or folder"),
    ],
)
def test_sources_that_nobody_reads(source: str, text: str) -> None:
    with pytest.raises(WrongSource, match=text):
        Camera(config(source), "left")


@pytest.mark.parametrize(
    "source", ["http://", "http://host:99999/", "http://user:secret@127.0.0.1/", "http://127.0.0.1/a b", "http://[::1/"]
)
def test_addresses_that_are_none(source: str) -> None:
    with pytest.raises(WrongSource, match="address"):
        Camera(config(source), "left")


def test_what_only_uvc_can_set_is_refused_elsewhere() -> None:
    with pytest.raises(WrongSource, match="exposure and white_balance are set through UVC only"):
        source_kind(config("http://127.0.0.1/", exposure=100.0), "left")
    with pytest.raises(WrongSource, match="UVC only"):
        source_kind(config("/tmp", white_balance=4000.0), "left")


# UVC. No camera here: what OpenCV's capture would answer


class FakeCapture:
    """Stands for cv2.VideoCapture: takes settings, except those it is told to keep."""

    keeps: dict[int, float] = {}
    opened = True
    image: np.ndarray | None = np.zeros((48, 64, 3), dtype=np.uint8)
    stamp: float | None = 0.01  # age of the buffer's time stamp; None: the driver gives 0 [s]
    ready = True
    made: list[FakeCapture] = []

    def __init__(self, source: str, backend: int) -> None:
        self.settings: dict[int, float] = {}
        self.order: list[int] = []
        self.released = False
        self.made.append(self)

    def isOpened(self) -> bool:
        return self.opened

    def set(self, setting: int, value: float) -> bool:
        self.order.append(setting)
        self.settings[setting] = self.keeps.get(setting, value)
        return setting not in self.keeps

    def get(self, setting: int) -> float:
        import cv2

        if setting == cv2.CAP_PROP_POS_MSEC:
            return 0.0 if self.stamp is None else 1e3 * (time.monotonic() - self.stamp)
        return self.settings.get(setting, 0.0)

    @staticmethod
    def waitAny(captures: list[FakeCapture], timeoutNs: int) -> tuple[bool, list[int]]:
        assert timeoutNs > 0
        time.sleep(0.005)
        return FakeCapture.ready, [0]

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        return self.image is not None, self.image

    def release(self) -> None:
        self.released = True


@pytest.fixture
def uvc(monkeypatch: pytest.MonkeyPatch) -> type[FakeCapture]:
    import cv2

    monkeypatch.setattr(cv2, "VideoCapture", FakeCapture)
    for name, value in (("keeps", {}), ("opened", True), ("stamp", 0.01), ("ready", True), ("made", [])):
        monkeypatch.setattr(FakeCapture, name, value)
    monkeypatch.setattr(FakeCapture, "image", np.full((48, 64, 3), (255, 0, 0), dtype=np.uint8))
    return FakeCapture


DEVICE = "/dev/null"  # any path in /dev that is there


def test_uvc_sets_the_format_before_the_size_and_keeps_exposure(uvc: type[FakeCapture]) -> None:
    import cv2

    with Camera(config(DEVICE, exposure=150.0, white_balance=4500.0), "left") as camera:
        frame = camera.read(20.0)
        assert tuple(frame.image[0, 0]) == (0, 0, 255)  # RGB
        assert camera.status.clock == "device" and abs(time.monotonic() - frame.time) < 20.0
    order = uvc.made[0].order
    assert order.index(cv2.CAP_PROP_FOURCC) < order.index(cv2.CAP_PROP_FRAME_WIDTH)
    assert order.index(cv2.CAP_PROP_AUTO_EXPOSURE) < order.index(cv2.CAP_PROP_EXPOSURE)
    assert uvc.made[0].settings[cv2.CAP_PROP_AUTO_WB] == 0
    assert uvc.made[0].released


def test_uvc_leaves_alone_what_was_not_asked_for(uvc: type[FakeCapture]) -> None:
    import cv2

    capture = UvcCapture(config(DEVICE), "left")
    capture.close()
    assert not {cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_AUTO_WB} & set(uvc.made[0].order)


@pytest.mark.promise(11)
@pytest.mark.parametrize(
    ("setting", "value", "text"),
    [
        ("CAP_PROP_FRAME_WIDTH", 640.0, r"width \[px\] was set to 64 and reads back 640 \(refused\)"),
        ("CAP_PROP_FRAME_HEIGHT", 480.0, "height"),
        ("CAP_PROP_FPS", 25.0, "fps was set to 30 and reads back 25"),
        ("CAP_PROP_AUTO_EXPOSURE", 3.0, "automatic exposure"),
        ("CAP_PROP_EXPOSURE", 166.0, "exposure was set to 150 and reads back 166"),
        ("CAP_PROP_AUTO_WB", 1.0, "automatic white balance"),
        ("CAP_PROP_WB_TEMPERATURE", float("nan"), "white_balance"),
    ],
)
def test_uvc_refuses_what_reads_back_otherwise(
    uvc: type[FakeCapture], monkeypatch: pytest.MonkeyPatch, setting: str, value: float, text: str
) -> None:
    import cv2

    monkeypatch.setattr(uvc, "keeps", {getattr(cv2, setting): value})
    with pytest.raises(WrongSource, match=text):
        Camera(config(DEVICE, exposure=150.0, white_balance=4500.0), "left")
    assert all(made.released for made in uvc.made)


@pytest.mark.parametrize("age", [None, -5.0, 1e6])
def test_uvc_stamps_of_another_clock_are_not_used(
    uvc: type[FakeCapture], monkeypatch: pytest.MonkeyPatch, age: float | None
) -> None:
    monkeypatch.setattr(uvc, "stamp", age)
    with Camera(config(DEVICE, latency=0.5), "left") as camera:
        assert time.monotonic() - camera.read(20.0).time > 0.5
        assert camera.status.clock == "arrival"


def test_uvc_reopens_after_a_stall_and_after_unplugging(
    uvc: type[FakeCapture], monkeypatch: pytest.MonkeyPatch
) -> None:
    with Camera(config(DEVICE, max_age=0.2), "left") as camera:
        camera.read(20.0)
        monkeypatch.setattr(uvc, "ready", False)
        while camera.status.reopened < 1:
            time.sleep(0.005)
        monkeypatch.setattr(uvc, "ready", True)
        camera.read(20.0)
        monkeypatch.setattr(uvc, "image", None)
        while camera.status.reopened < 3:
            time.sleep(0.005)
        assert camera.status.error is not None and "unplugged" in camera.status.error
        monkeypatch.setattr(uvc, "image", np.zeros((48, 64, 3), dtype=np.uint8))
        camera.read(20.0)
    assert len(uvc.made) >= 4 and all(made.released for made in uvc.made)


def test_uvc_frames_of_another_size_are_refused(uvc: type[FakeCapture], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uvc, "image", np.zeros((60, 64, 3), dtype=np.uint8))
    with pytest.raises(WrongSource, match="frames are 64 x 60 px, expected are 64 x 48"):
        Camera(config(DEVICE), "left")


def test_uvc_that_cannot_be_opened(uvc: type[FakeCapture], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uvc, "opened", False)
    with pytest.raises(DeviceNotConnectedError, match="another program holds it"):
        Camera(config(DEVICE), "left", connect_timeout=0.5)
    with pytest.raises(DeviceNotConnectedError, match="is it plugged in"):
        Camera(config("/dev/v4l/by-id/usb-none-video-index0"), "left", connect_timeout=0.5)


def test_one_function_chooses_the_source(server: Server, uvc: type[FakeCapture], tmp_path: object) -> None:
    server.talk = says(STREAM)
    Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(f"{tmp_path}/a.png")
    for source, kind in ((server.url, MjpegCapture), (DEVICE, UvcCapture), (str(tmp_path), PlayedCapture)):
        opened = capture.open_capture(config(source), "left", threading.Event())
        assert isinstance(opened, kind)
        opened.close()

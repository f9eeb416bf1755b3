"""One opened source of pictures, as long as it lasts: an MJPEG stream, a UVC camera, a folder of pictures or a video.

A capture never mends itself: when it fails, the driver (`robot.camera`) closes it and opens another. No read waits
longer than `READ_TIMEOUT` for a live source.

The stream is read with the standard library and Pillow, not with OpenCV's FFmpeg: sizes are checked before anything is
decoded, every wait has a deadline (FFmpeg's cover neither names nor a header that never ends), frames that came while
the reader was away can be told from new ones, no proxy is asked, and no native thread is left at exit.
"""

from __future__ import annotations

import http.client
import io
import math
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from robot import stamp
from robot.errors import DeviceError, DeviceNotConnectedError
from tacsim.hardware import CameraSensorFacts
from tacsim.interface import EndOfEpisode

CONNECT_TIMEOUT = 1.0  # to connect and get the header of the answer [s]
READ_TIMEOUT = 0.5  # a live source that sends no whole frame for so long, plus three periods, is reopened [s]
_MAX_LINE = 8192  # of the header of a part [bytes]
_MAX_LINES = 64
_CHUNK = 65536


class WrongSource(DeviceError):
    """The source answers, but it is not what the rig file says: another size, no stream, a setting it does not take."""


class DamagedFrame(Exception):
    """One picture that cannot be decoded; the next may be whole."""


@dataclass(frozen=True, slots=True)
class Picture:
    """One frame as the source gave it."""

    image: NDArray[np.uint8]  # (H, W, 3) RGB, with the strip if the source burns one in
    arrival: float  # monotonic clock when the last of it was here [s]
    exposure: float | None  # by the device's own stamp, on the monotonic clock; None: it gives none [s]


class Capture(Protocol):
    """What the driver needs of a source."""

    live: bool  # goes on in real time: worth reopening when it fails

    def read(self) -> Picture:
        """The next frame, waited for. Raises DamagedFrame, WrongSource, EndOfEpisode, OSError (TimeoutError: stalled);
        all but the first end the capture."""
        ...

    def interrupt(self) -> None:
        """Makes a `read` of another thread return soon."""
        ...

    def close(self) -> None: ...


def frame_size(facts: CameraSensorFacts) -> tuple[int, int]:
    """Rows and columns of the frames that are expected, the strip of a stamped source included [px]."""
    return facts.height + (stamp.strip_rows(facts.width) if facts.stamped else 0), facts.width


def open_capture(facts: CameraSensorFacts, name: str, stop: threading.Event) -> Capture:
    """Opens the source of sensor `name`; `stop` ends its waits. Raises WrongSource, OSError or DeviceError."""
    kind = source_kind(facts, name)
    if kind == "stream":
        return MjpegCapture(facts, name)
    if kind == "uvc":
        return UvcCapture(facts, name)
    return PlayedCapture(facts, name, stop)


def source_kind(facts: CameraSensorFacts, name: str) -> str:
    """ "stream", "uvc", "folder" or "video". Raises WrongSource for what none of them reads, or a setting that this kind
    cannot keep."""
    source, where = facts.source, f"sensor '{name}': source '{facts.source}'"
    if source.startswith("http://"):
        kind = "stream"
    elif "://" in source:
        raise WrongSource(f"{where}: only http:// streams (MJPEG) are read")
    elif source.lstrip("-").isdigit() or source.startswith("/dev/video"):
        raise WrongSource(
            f"{where} is an index; indices change with each plug and boot, so two sensors get exchanged unnoticed. Name "
            "the camera by its serial number: a path in /dev/v4l/by-id/ that ends in -index0"
        )
    elif source.startswith("/dev/"):
        kind = "uvc"
    else:
        path = Path(source)
        if not path.exists():
            raise WrongSource(f"{where}: no such file or folder")
        kind = "folder" if path.is_dir() else "video"
    if kind != "uvc" and (facts.exposure is not None or facts.white_balance is not None):
        raise WrongSource(
            f"{where}: exposure and white_balance are set through UVC only; fix them where the picture is made, and leave "
            "them out here"
        )
    return kind


class MjpegCapture:
    """MJPEG over HTTP (multipart/x-mixed-replace), with or without lengths of the parts, chunked or not."""

    live = True

    def __init__(self, facts: CameraSensorFacts, name: str) -> None:
        self._what = f"sensor '{name}': {facts.source}"
        self._size = frame_size(facts)
        self._timeout = READ_TIMEOUT + 3.0 / facts.fps
        # Uncompressed pictures need less; a part that is longer is no picture of this size.
        self._limit = 3 * self._size[0] * self._size[1] + _CHUNK
        self._buffer = bytearray()
        self._socket = _connect(facts.source, self._what)
        try:
            self._answer, self._boundary = self._ask(facts.source)
        except BaseException:
            self._socket.close()
            raise

    def _ask(self, url: str) -> tuple[http.client.HTTPResponse, bytes]:
        parts = urlsplit(url)
        target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        request = f"GET {target} HTTP/1.1\r\nHost: {parts.netloc}\r\nUser-Agent: tacsim\r\nConnection: close\r\n\r\n"
        self._socket.sendall(request.encode("ascii", "strict"))
        answer = http.client.HTTPResponse(self._socket, method="GET")
        try:
            answer.begin()
        except http.client.HTTPException as error:
            answer.close()
            raise WrongSource(f"{self._what}: no HTTP answer ({type(error).__name__}: {error})") from error
        kind = answer.headers.get_content_type()
        boundary = answer.headers.get_boundary()
        if answer.status != 200:
            reason = f"HTTP status {answer.status} {answer.reason}; check the path (mjpg-streamer: /?action=stream)"
        elif kind != "multipart/x-mixed-replace":
            reason = f"content of type {kind}, not an MJPEG stream (multipart/x-mixed-replace); check the path"
        elif not boundary:
            reason = "a stream without boundary; is that an MJPEG camera?"
        else:
            return answer, b"--" + boundary.strip('"').removeprefix("--").encode("latin-1")
        answer.close()
        raise WrongSource(f"{self._what}: {reason}")

    def read(self) -> Picture:
        self._socket.deadline = time.monotonic() + self._timeout
        try:
            data = self._part()
        except http.client.HTTPException as error:
            raise ConnectionError(f"{self._what}: the stream broke off ({type(error).__name__})") from error
        return Picture(self._decode(data), time.monotonic(), None)

    def _part(self) -> bytes:
        """The bytes of the next picture."""
        line = self._line()
        skipped = 0
        while not line.startswith(self._boundary):  # the end of the line after a picture; junk before the first
            skipped += len(line) + 2
            if skipped > self._limit:
                raise WrongSource(f"{self._what}: no boundary within {skipped} bytes; is that an MJPEG camera?")
            line = self._line()
        length = None
        for _ in range(_MAX_LINES):
            line = self._line()
            if not line:
                break
            key, _, value = line.partition(b":")
            if key.strip().lower() == b"content-length" and value.strip().isdigit() and len(value) < 20:
                length = int(value)
        else:
            raise WrongSource(
                f"{self._what}: a part with more than {_MAX_LINES} header lines; is that an MJPEG camera?"
            )
        if length is None:
            return self._until_boundary()
        if length > self._limit:
            raise WrongSource(
                f"{self._what}: a picture of {length} bytes; {self._size[1]} x {self._size[0]} px need at most {self._limit}"
            )
        while len(self._buffer) < length:
            self._receive()
        return self._take(length)

    def _until_boundary(self) -> bytes:
        mark, start = b"\r\n" + self._boundary, 0
        while (end := self._buffer.find(mark, start)) < 0:
            if len(self._buffer) > self._limit:
                raise WrongSource(f"{self._what}: no end of the picture within {self._limit} bytes")
            start = max(0, len(self._buffer) - len(mark))
            self._receive()
        return self._take(end)

    def _line(self) -> bytes:
        start = 0
        while (end := self._buffer.find(b"\n", start)) < 0 and len(self._buffer) <= _MAX_LINE:
            start = len(self._buffer)
            self._receive()
        if not 0 <= end <= _MAX_LINE:
            raise WrongSource(f"{self._what}: a line of more than {_MAX_LINE} bytes; is that an MJPEG camera?")
        return self._take(end + 1).rstrip(b"\r\n")

    def _receive(self) -> None:
        data = self._answer.read1(_CHUNK)
        if not data:
            raise ConnectionError(f"{self._what}: the camera ended the stream")
        self._buffer += data

    def _take(self, count: int) -> bytes:
        data = bytes(self._buffer[:count])
        del self._buffer[:count]
        return data

    def _decode(self, data: bytes) -> NDArray[np.uint8]:
        from PIL import Image

        try:
            with Image.open(io.BytesIO(data), formats=("JPEG",)) as picture:
                if picture.size != self._size[::-1]:
                    raise wrong_size(self._what, (picture.size[1], picture.size[0]), self._size)
                return np.array(picture.convert("RGB"))
        except WrongSource:
            raise
        except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
            raise WrongSource(f"{self._what}: {error}; expected are {self._size[1]} x {self._size[0]} px") from error
        except Exception as error:  # a decoder that is fed damaged bytes may raise anything
            raise DamagedFrame(f"{self._what}: no readable JPEG: {error}") from error

    def interrupt(self) -> None:
        try:
            self._socket.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass  # it is closed already

    def close(self) -> None:
        self._answer.close()
        self._socket.close()


class _DeadlineSocket(socket.socket):
    """A socket whose receiving ends at a deadline, however slowly bytes drip."""

    deadline = math.inf  # monotonic clock [s]

    def recv_into(self, *arguments: Any) -> int:
        left = self.deadline - time.monotonic()
        if left <= 0.0:
            raise TimeoutError("no whole frame came in time")
        self.settimeout(left)
        return super().recv_into(*arguments)


def _connect(url: str, what: str) -> _DeadlineSocket:
    """A connected socket; its deadline is set for the header. Raises OSError, WrongSource for no address."""
    deadline = time.monotonic() + CONNECT_TIMEOUT
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port or 80
    except ValueError as error:
        raise WrongSource(f"{what}: no address ({error})") from error
    if not host or parts.username is not None or not url.isascii() or not url.isprintable() or " " in url:
        raise WrongSource(f"{what}: an address looks like http://host:port/?action=stream (no user, no blanks)")
    failure: OSError = TimeoutError(f"{what}: nobody answers")
    for family, kind, protocol, _, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
        connection = _DeadlineSocket(family, kind, protocol)
        try:
            connection.settimeout(max(1e-3, deadline - time.monotonic()))
            connection.connect(address)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.deadline = deadline
            return connection
        except OSError as error:
            connection.close()
            failure = error
        except BaseException:
            connection.close()
            raise
    raise failure


class UvcCapture:
    """A UVC camera of Linux (V4L2) by its serial path: MJPG, size, rate, exposure and white balance set and read back."""

    live = True

    def __init__(self, facts: CameraSensorFacts, name: str) -> None:
        import cv2

        self._what = f"sensor '{name}': {facts.source}"
        self._size = frame_size(facts)
        self._timeout = READ_TIMEOUT + 3.0 / facts.fps
        if not Path(facts.source).exists():
            raise DeviceNotConnectedError(f"{self._what}: no such device; is it plugged in? (ls /dev/v4l/by-id)")
        self._capture = cv2.VideoCapture(facts.source, cv2.CAP_V4L2)
        try:
            if not self._capture.isOpened():
                raise DeviceNotConnectedError(
                    f"{self._what}: cannot be opened; another program holds it, or this user may not (group video)"
                )
            self._configure(facts)
        except BaseException:
            self._capture.release()
            raise

    def _configure(self, facts: CameraSensorFacts) -> None:
        """Fourcc before the size: many cameras offer large sizes only compressed."""
        import cv2

        self._capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self._keep(cv2.CAP_PROP_FRAME_WIDTH, self._size[1], "width [px]", 0.5)
        self._keep(cv2.CAP_PROP_FRAME_HEIGHT, self._size[0], "height [px]", 0.5)
        self._keep(cv2.CAP_PROP_FPS, facts.fps, "fps", 0.05 * facts.fps)
        if facts.exposure is not None:
            self._keep(cv2.CAP_PROP_AUTO_EXPOSURE, 1, "automatic exposure (1: off)", 0.1)
            self._keep(cv2.CAP_PROP_EXPOSURE, facts.exposure, "exposure", 0.01 * abs(facts.exposure) + 1e-9)
        if facts.white_balance is not None:
            self._keep(cv2.CAP_PROP_AUTO_WB, 0, "automatic white balance", 0.1)
            self._keep(cv2.CAP_PROP_WB_TEMPERATURE, facts.white_balance, "white_balance [K]", 0.5)

    def _keep(self, setting: int, value: float, what: str, tolerance: float) -> None:
        taken = self._capture.set(setting, value)
        got = self._capture.get(setting)
        if not abs(got - value) <= tolerance:
            raise WrongSource(
                f"{self._what}: {what} was set to {value:g} and reads back {got:g}{'' if taken else ' (refused)'}; give "
                "what the camera has (v4l2-ctl --list-formats-ext, --list-ctrls)"
            )

    def read(self) -> Picture:
        import cv2

        ready, _ = cv2.VideoCapture.waitAny([self._capture], timeoutNs=int(1e9 * self._timeout))
        if not ready:
            raise TimeoutError(f"{self._what}: no frame for {self._timeout:.2g} s")
        there, image = self._capture.retrieve()  # waitAny has grabbed it
        arrival = time.monotonic()
        if not there or image is None:
            raise ConnectionError(f"{self._what}: no frame; was it unplugged?")
        if image.shape != (*self._size, 3):
            raise wrong_size(self._what, image.shape[:2], self._size)
        # The time V4L2 gives to the buffer, by the monotonic clock with nearly all drivers. Others say 0 or an epoch.
        exposure = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
        picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
        return Picture(picture, arrival, exposure if 0.0 <= arrival - exposure < 1.0 else None)

    def interrupt(self) -> None:
        """Nothing to do: a read waits READ_TIMEOUT at most."""

    def close(self) -> None:
        self._capture.release()


class PlayedCapture:
    """A folder of pictures or a video, played once at its rate, as a stand-in for a camera."""

    live = False

    def __init__(self, facts: CameraSensorFacts, name: str, stop: threading.Event) -> None:
        from tacsim.record.episode import EpisodeError
        from tacsim.record.sources import folder_images, list_pictures, video_images, video_rate

        self._what = f"sensor '{name}': {facts.source}"
        self._size = frame_size(facts)
        self._stop = stop
        path = Path(facts.source)
        make: Callable[[], Iterator[NDArray[np.uint8]]]
        try:
            if path.is_dir():
                rate, self._images = facts.fps, folder_images(list_pictures(path))
            else:
                rate, self._images = video_rate(path) or facts.fps, video_images(path)
        except (EpisodeError, OSError) as error:
            raise WrongSource(f"{self._what}: {error}") from error
        self._period = 1.0 / rate
        self._due: float | None = None  # when the next picture is shown

    def read(self) -> Picture:
        from tacsim.record.episode import EpisodeError

        if self._due is not None and self._stop.wait(max(0.0, self._due - time.monotonic())):
            raise EndOfEpisode(f"{self._what}: closed")
        try:
            image = next(self._images, None)
        except (EpisodeError, OSError) as error:
            raise WrongSource(f"{self._what}: {error}") from error
        if image is None:
            raise EndOfEpisode(f"{self._what} is over")
        if image.shape != (*self._size, 3):
            raise wrong_size(self._what, image.shape[:2], self._size)
        now = time.monotonic()
        self._due = now + self._period if self._due is None else max(self._due + self._period, now)
        return Picture(image, now, None)

    def interrupt(self) -> None:
        """Nothing to do: `stop` ends the wait."""

    def close(self) -> None:
        close = getattr(self._images, "close", None)
        if close is not None:
            close()


def wrong_size(what: str, got: tuple[int, ...], expected: tuple[int, int]) -> WrongSource:
    """Rows, columns [px]."""
    return WrongSource(
        f"{what}: frames are {got[1]} x {got[0]} px, expected are {expected[1]} x {expected[0]}; correct width, height or "
        "stamped in the rig file (a stamped source has its strip below `height`), or the camera"
    )

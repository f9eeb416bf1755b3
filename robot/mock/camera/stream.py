"""Server of the mock camera: makes frames from images, and sends frames to clients like mjpg-streamer.

One thread exposes and encodes. Each client has a thread that sends only the newest frame, so a slow client loses frames
and does not fill the memory. Standard library and Pillow only.
"""

from __future__ import annotations

import contextlib
import io
import random
import socket
import threading
import time
from collections import deque
from dataclasses import asdict, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from robot.common import stamp
from robot.mock.camera.camera import Faults

BOUNDARY = "boundarydonotcross"
MAX_CLIENTS = 16
SHIFTS = 32  # of the noise image, in rows and in columns: it is drawn once
SEND_TIMEOUT = 5.0  # a client that reads nothing for this time is disconnected [s]


class FrameSource:
    """Exposes images at `fps`, and a pushed image at once; stores the newest JPEG for the clients."""

    def __init__(self, width: int, height: int, fps: float, quality: int, stamped: bool, noise: int) -> None:
        max_delayed = 1024  # frames that wait for their delay; of more the oldest is lost
        self.width, self.height = width, height
        self._period, self._quality, self._stamped = 1.0 / fps, quality, stamped
        self._changed = threading.Condition()  # protects all attributes below
        self._faults = Faults()
        self._picture: NDArray[np.uint8] | None = None  # the last pushed image
        self._fresh = False  # True until it is exposed
        self._delayed: deque[tuple[float, int, bytes]] = deque(maxlen=max_delayed)  # when to send, number, JPEG
        self._newest: tuple[int, bytes] = (0, b"")  # number of frames sent so far; JPEG
        self._number = 0  # of the newest
        self._exposed = b""  # the newest JPEG, undamaged
        self._closed = False
        self._random = random.Random(0)
        self._noise: NDArray[np.int16] | None = None  # larger than an image; each frame gets another part of it
        if noise:
            size = (height + SHIFTS, width + SHIFTS, 3)
            self._noise = np.random.default_rng(0).integers(-noise, noise + 1, size, dtype=np.int16)
        self.counts = {"frames": 0, "images": 0, "dropped": 0, "sent": 0, "skipped": 0}

    def push(self, picture: NDArray[np.uint8]) -> int:
        """Sets the image (H, W, 3) RGB; returns its number, which the stamps of its frames contain."""
        with self._changed:
            self._picture, self._fresh = picture, True
            self.counts["images"] += 1
            self._changed.notify_all()
            return self.counts["images"]

    def set_fault(self, name: str, value: Any) -> None:
        """Sets one of `Faults`. Raises ValueError for another name."""
        if name not in Faults.__dataclass_fields__:
            raise ValueError(f"no command '{name}'")
        with self._changed:
            self._faults = replace(self._faults, **{name: value})
            if self._faults.stall:
                self.counts["dropped"] += len(self._delayed)
                self._delayed.clear()
            self._changed.notify_all()

    def state(self) -> dict[str, Any]:
        with self._changed:
            return {**self.counts, **asdict(self._faults)}

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def newer(self, than: int) -> tuple[int, bytes] | None:
        """Waits for a frame that is newer than number `than`; returns its number among the sent frames, and its JPEG;
        None when the camera is closed. Counts the frames that a slow client has missed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._newest[0] > than)
            if self._closed:
                return None
            self.counts["skipped"] += self._newest[0] - than - 1
            self.counts["sent"] += 1
            return self._newest

    @property
    def newest(self) -> tuple[int, bytes]:
        """Number of the newest frame among those that were sent, 0 before the first, and its JPEG."""
        with self._changed:
            return self._newest

    def run(self) -> None:
        """Exposes until `close`. A pushed image does not wait for the next tick, which follows one period later: a rig
        in lock step waits for this image, and would lose up to one period in each step."""
        tick = time.monotonic()
        while True:
            with self._changed:
                while not self._closed:
                    now = time.monotonic()
                    self._send_delayed(now)
                    if not self._faults.stall and (self._fresh or now >= tick):
                        break
                    self._changed.wait(self._time_to_next(tick, now))
                if self._closed:
                    return
                tick = now + self._period if self._fresh else max(tick + self._period, now)
                self._fresh = False
                picture, image, faults = self._picture, self.counts["images"], self._faults
                self.counts["frames"] += 1
                number = self.counts["frames"]
            jpeg = self._expose(picture, stamp.Stamp(number, image, time.monotonic_ns() // 1000), faults)
            with self._changed:
                # a frame that was exposed before a stall must not be sent after it
                if self._faults.stall or (faults.drop > 0.0 and self._random.random() < faults.drop):
                    self.counts["dropped"] += 1
                    continue
                self._delayed.append((now + faults.delay, number, jpeg))

    def _time_to_next(self, tick: float, now: float) -> float | None:
        """How long there is nothing to do [s]; None: until `_changed` is notified."""
        due = [] if self._faults.stall else [tick]
        if self._delayed:
            due.append(self._delayed[0][0])
        return max(0.0, min(due) - now) if due else None

    def _send_delayed(self, now: float) -> None:
        while self._delayed and self._delayed[0][0] <= now:
            _, number, jpeg = self._delayed.popleft()
            if number > self._number:  # with a shorter delay, later frames overtake earlier ones
                self._number, self._newest = number, (self._newest[0] + 1, jpeg)
                self._changed.notify_all()

    def _expose(self, picture: NDArray[np.uint8] | None, mark: stamp.Stamp, faults: Faults) -> bytes:
        if not (faults.freeze and self._exposed):
            self._exposed = self._encode(picture, mark, faults)
        return self._damage(self._exposed, faults)

    def _encode(self, picture: NDArray[np.uint8] | None, mark: stamp.Stamp, faults: Faults) -> bytes:
        if picture is None:
            picture = moving_disc_picture(self.width, self.height, mark.frame)
        if self._noise is not None:
            down, right = self._random.randrange(SHIFTS), self._random.randrange(SHIFTS)
            noise = self._noise[down : down + self.height, right : right + self.width]
            picture = np.clip(picture + noise, 0, 255).astype(np.uint8)
        if faults.brightness != 1.0:
            picture = np.clip(np.rint(picture * faults.brightness), 0, 255).astype(np.uint8)
        if faults.size is not None:
            picture = np.asarray(Image.fromarray(picture).resize(faults.size), dtype=np.uint8)
        if self._stamped:
            picture = stamp.draw(picture, mark)
        return encode_jpeg(picture, self._quality)

    def _damage(self, jpeg: bytes, faults: Faults) -> bytes:
        half = len(jpeg) // 2
        if faults.corrupt:
            jpeg = jpeg[:half] + self._random.randbytes(len(jpeg) - half)
        if faults.cut:
            jpeg = jpeg[:half] + jpeg[-2:]
        if faults.flip:
            scan, flipped = jpeg.index(b"\xff\xda"), bytearray(jpeg)
            for _ in range(faults.flip):
                flipped[self._random.randrange(scan, len(jpeg) - 2)] ^= self._random.randrange(1, 256)
            jpeg = bytes(flipped)
        return jpeg


def encode_jpeg(picture: NDArray[np.uint8], quality: int) -> bytes:
    """(H, W, 3) RGB -> JPEG with colour at half resolution (4:2:0), as in cameras."""
    data = io.BytesIO()
    Image.fromarray(picture).save(data, "JPEG", quality=quality, subsampling=2)
    return data.getvalue()


def moving_disc_picture(width: int, height: int, number: int) -> NDArray[np.uint8]:
    """Image (H, W, 3) before the first push: a grey gel with a dark disc that moves on a circle, once in 120 frames."""
    angle = 2.0 * np.pi * (number % 120) / 120
    x = np.arange(width) - width * (0.5 + 0.25 * np.cos(angle))
    y = np.arange(height) - height * (0.5 + 0.25 * np.sin(angle))
    inside = x[None, :] ** 2 + y[:, None] ** 2 < (0.1 * min(width, height)) ** 2
    return np.repeat(np.where(inside, 64, 128).astype(np.uint8)[:, :, None], 3, axis=2)


class Listener:
    """The camera's port: sends the frames of a source to HTTP clients."""

    def __init__(self, host: str, port: int, source: FrameSource) -> None:
        self.source = source
        self._clients: set[socket.socket] = set()
        self._lock = threading.Lock()
        self._host = host
        self._server: _Server | None = None
        self.port = port
        self.listen()

    def listen(self) -> None:
        """Opens the port. Raises OSError if it is taken."""
        if self._server is None:
            self._server = _Server((self._host, self.port), self)
            self.port = self._server.server_address[1]  # chosen by the system for port 0; then kept
            threading.Thread(target=self._server.serve_forever, args=(0.02,), name="listener", daemon=True).start()

    def refuse(self) -> None:
        """Closes the port; connected clients stay."""
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._server = None

    def clients(self) -> int:
        with self._lock:
            return len(self._clients)

    def disconnect(self) -> int:
        """Disconnects all clients; returns their number."""
        with self._lock:
            for client in self._clients:
                with contextlib.suppress(OSError):
                    client.shutdown(socket.SHUT_RDWR)
            return len(self._clients)

    def enter(self, client: socket.socket) -> bool:
        """Adds a client; False if there are MAX_CLIENTS already."""
        with self._lock:
            if len(self._clients) >= MAX_CLIENTS:
                return False
            self._clients.add(client)
            return True

    def leave(self, client: socket.socket) -> None:
        with self._lock:
            self._clients.discard(client)


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], listener: Listener) -> None:
        self.listener = listener
        super().__init__(address, _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that disconnects is no error."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = SEND_TIMEOUT
    disable_nagle_algorithm = True

    def log_message(self, format: str, *args: Any) -> None:
        """Logs nothing."""

    def do_GET(self) -> None:
        action = {"/?action=stream": self._stream, "/?action=snapshot": self._snapshot}.get(self.path)
        if action is None:
            self.send_error(404, "use /?action=stream or /?action=snapshot")
            return
        if not self.server.listener.enter(self.connection):
            self.send_error(503, f"{MAX_CLIENTS} clients are connected already")
            return
        try:
            action()
        finally:
            self.server.listener.leave(self.connection)

    def _stream(self) -> None:
        # A small buffer: its contents are old when a slow client reads them.
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 65536)
        last = self.server.listener.source.newest[0]  # older frames are not sent
        self._head(f"multipart/x-mixed-replace;boundary={BOUNDARY}")
        self.wfile.write(f"--{BOUNDARY}\r\n".encode())
        while (frame := self.server.listener.source.newer(last)) is not None:
            last, jpeg = frame
            head = f"Content-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\nX-Timestamp: {time.time():.6f}\r\n\r\n"
            self.wfile.write(head.encode() + jpeg + f"\r\n--{BOUNDARY}\r\n".encode())

    def _snapshot(self) -> None:
        number, jpeg = self.server.listener.source.newest
        if number == 0:
            self.send_error(503, "no frame yet")
            return
        self._head("image/jpeg")
        self.wfile.write(jpeg)

    def _head(self, kind: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Connection", "close")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()

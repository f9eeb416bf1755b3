"""HTTP servers that send what a test defines, and cameras of 64 x 48 px."""

from __future__ import annotations

import io
import itertools
import socket
import threading
from collections.abc import Callable

import numpy as np
from PIL import Image

from tacsim.models.hardware import CameraSensorConfig
from tests.robot.camera.mocked import HOST

OK = b"HTTP/1.1 200 OK\r\n"
STREAM = OK + b"Content-Type: multipart/x-mixed-replace;boundary=here\r\n\r\n"


def config(source: str, **options: object) -> CameraSensorConfig:
    known: dict[str, object] = {"width": 64, "height": 48, "fps": 30.0, "max_age": 10.0}
    return CameraSensorConfig.model_validate({"driver": "camera", "source": source, **known, **options})


def jpeg(value: int = 100, shape: tuple[int, int] = (48, 64)) -> bytes:
    return encoded(np.full((*shape, 3), value, dtype=np.uint8))


def encoded(image: np.ndarray) -> bytes:
    data = io.BytesIO()
    Image.fromarray(image).save(data, "JPEG", quality=95)
    return data.getvalue()


def seen(value: int, number: int, shape: tuple[int, int] = (48, 64)) -> np.ndarray:
    """What a real camera makes of a grey wall: no two pictures are the same."""
    return np.random.default_rng(number).integers(value - 2, value + 3, (*shape, 3), dtype=np.uint8)


def part(data: bytes, *lines: bytes) -> bytes:
    return b"--here\r\n" + b"".join(line + b"\r\n" for line in lines) + b"\r\n" + data + b"\r\n"


def length(data: bytes) -> bytes:
    return b"Content-Length: %d" % len(data)


Talk = Callable[[socket.socket], None]


class Server:
    """Answers each client in a thread with the bytes that `talk` sends."""

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


def films(server: Server, picture: Callable[[int], bytes], every: float = 0.01) -> Talk:
    """Sends `picture(0)`, `picture(1)`, ... to each client."""

    def talk(client: socket.socket) -> None:
        client.settimeout(5.0)
        client.sendall(STREAM)
        for number in itertools.count():
            data = picture(number)
            client.sendall(part(data, length(data)))
            server.wait(every)

    return talk


def says(*parts: bytes) -> Talk:
    def talk(client: socket.socket) -> None:
        client.settimeout(5.0)
        for part in parts:
            client.sendall(part)

    return talk

"""A client of the mock camera, and what tests of its process need."""

from __future__ import annotations

import http.client
import io
import os
import socket

import numpy as np
from PIL import Image

from robot.common import stamp
from robot.mock.camera.camera import MockCamera

HOST = f"127.22.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"  # parallel sessions stay apart
WAIT = 20.0  # for what must come, however slow the machine [s]


def get(camera: MockCamera, path: str) -> tuple[int, str, bytes]:
    connection = http.client.HTTPConnection(camera.host, camera.port, timeout=WAIT)
    try:
        connection.request("GET", path)
        answer = connection.getresponse()
        return answer.status, answer.headers["Content-Type"], answer.read()
    finally:
        connection.close()


class Client:
    """A plain reader of the stream."""

    def __init__(self, camera: MockCamera) -> None:
        self._socket = socket.create_connection((camera.host, camera.port), timeout=WAIT)
        self._socket.sendall(b"GET /?action=stream HTTP/1.0\r\n\r\n")
        self._file = self._socket.makefile("rb")
        self.head = self._lines()

    def _lines(self) -> list[str]:
        lines = []
        while (line := self._file.readline()) != b"\r\n":
            if not line:
                raise ConnectionError("cut")
            lines.append(line.decode().strip())
        return lines

    def jpeg(self) -> bytes:
        head = self._lines()
        while not any(line.startswith("Content-Length") for line in head):
            head = self._lines()
        (length,) = (int(line.split(":")[1]) for line in head if line.startswith("Content-Length"))
        data = self._file.read(length)
        assert self._file.readline() == b"\r\n"
        return data

    def frame(self) -> tuple[np.ndarray, stamp.Stamp]:
        picture, mark = stamp.split(np.array(Image.open(io.BytesIO(self.jpeg())).convert("RGB")))
        assert mark is not None
        return picture, mark

    def close(self) -> None:
        self._file.close()
        self._socket.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

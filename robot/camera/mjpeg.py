"""MJPEG over HTTP: one open stream, read with the standard library.

Not by OpenCV's FFmpeg: this module checks sizes before decoding, gives every wait a deadline (FFmpeg has none for a
header without an end), uses no proxy, and leaves no native thread at exit.
"""

from __future__ import annotations

import contextlib
import http.client
import math
import socket
import time
from typing import Any
from urllib.parse import urlsplit

from robot.camera.picture import (
    CONNECT_TIMEOUT,
    READ_TIMEOUT,
    Picture,
    WrongSource,
    decode_jpeg,
    frame_size,
)
from tacsim.models.hardware import CameraSensorConfig

_CHUNK = 65536


class MjpegCapture:
    """MJPEG over HTTP (multipart/x-mixed-replace), with or without part lengths, chunked or not."""

    live = True

    def __init__(self, config: CameraSensorConfig, name: str) -> None:
        self._description = f"sensor '{name}': {config.source}"
        self._size = frame_size(config)
        self._timeout = READ_TIMEOUT + 3.0 / config.fps
        # Larger than an uncompressed picture; a longer part is not a picture of this size.
        self._limit = 3 * self._size[0] * self._size[1] + _CHUNK
        self._buffer = bytearray()
        self._delimiter = b""  # the boundary as the camera sends it
        self._socket = _connect(config.source, self._description)
        try:
            self._answer, self._boundary = self._send_request(config.source)
        except BaseException:
            self._socket.close()
            raise

    def _send_request(self, url: str) -> tuple[http.client.HTTPResponse, bytes]:
        parts = urlsplit(url)
        target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        request = f"GET {target} HTTP/1.1\r\nHost: {parts.netloc}\r\nUser-Agent: tacsim\r\nConnection: close\r\n\r\n"
        self._socket.sendall(request.encode("ascii", "strict"))
        answer = http.client.HTTPResponse(self._socket, method="GET")
        try:
            answer.begin()
        except http.client.HTTPException as error:
            answer.close()
            raise WrongSource(f"{self._description}: no HTTP answer ({type(error).__name__}: {error})") from error
        kind = answer.headers.get_content_type()
        boundary = _parse_boundary(answer.headers.get("Content-Type", ""))
        if answer.status != 200:
            reason = f"HTTP status {answer.status} {answer.reason}; check the path (mjpg-streamer: /?action=stream)"
        elif kind != "multipart/x-mixed-replace":
            reason = f"content of type {kind}, not an MJPEG stream (multipart/x-mixed-replace); check the path"
        elif not boundary:
            reason = "a stream without boundary; is it an MJPEG camera?"
        else:
            return answer, boundary.encode("latin-1", "replace")
        answer.close()
        raise WrongSource(f"{self._description}: {reason}")

    def read(self) -> Picture:
        self._socket.deadline = time.monotonic() + self._timeout
        try:
            data = self._read_part()
        except http.client.HTTPException as error:
            raise ConnectionError(
                f"{self._description}: the stream was interrupted ({type(error).__name__})"
            ) from error
        return Picture(decode_jpeg(data, self._size, self._description), time.monotonic(), None)

    def _read_part(self) -> bytes:
        """The bytes of the next picture."""
        max_lines = 64
        line = self._read_line()
        skipped = 0
        while not self._is_boundary(line):  # the line end after a picture, or data before the first
            skipped += len(line) + 2
            if skipped > self._limit:
                raise WrongSource(f"{self._description}: no boundary within {skipped} bytes; is it an MJPEG camera?")
            line = self._read_line()
        length = None
        for _ in range(max_lines):
            line = self._read_line()
            if not line:
                break
            key, _, value = line.partition(b":")
            if key.strip().lower() == b"content-length" and value.strip().isdigit() and len(value) < 20:
                length = int(value)
        else:
            raise WrongSource(
                f"{self._description}: a part with more than {max_lines} header lines; is it an MJPEG camera?"
            )
        if length is None:
            return self._read_until_boundary()
        if length > self._limit:
            raise WrongSource(
                f"{self._description}: a picture of {length} bytes; {self._size[1]} x {self._size[0]} px need "
                f"at most {self._limit}"
            )
        while len(self._buffer) < length:
            self._receive()
        return self._take_bytes(length)

    def _read_until_boundary(self) -> bytes:
        mark, start = b"\n" + self._delimiter, 0
        while (end := self._buffer.find(mark, start)) < 0:
            if len(self._buffer) > self._limit:
                raise WrongSource(f"{self._description}: no end of the picture within {self._limit} bytes")
            start = max(0, len(self._buffer) - len(mark))
            self._receive()
        return self._take_bytes(end).removesuffix(b"\r")

    def _is_boundary(self, line: bytes) -> bool:
        """True if a line is the boundary. The first one shows how many dashes this camera adds before it."""
        if self._delimiter:
            return line.startswith(self._delimiter)
        found = line.lstrip(b"-").startswith(self._boundary)
        if found:
            self._delimiter = line[: line.index(self._boundary) + len(self._boundary)]
        return found

    def _read_line(self) -> bytes:
        max_line = 8192  # of the header of a part [bytes]
        start = 0
        while (end := self._buffer.find(b"\n", start)) < 0 and len(self._buffer) <= max_line:
            start = len(self._buffer)
            self._receive()
        if not 0 <= end <= max_line:
            raise WrongSource(f"{self._description}: a line of more than {max_line} bytes; is it an MJPEG camera?")
        return self._take_bytes(end + 1).rstrip(b"\r\n")

    def _receive(self) -> None:
        data = self._answer.read1(_CHUNK)
        if not data:
            raise ConnectionError(f"{self._description}: the camera ended the stream")
        self._buffer += data

    def _take_bytes(self, count: int) -> bytes:
        data = bytes(self._buffer[:count])
        del self._buffer[:count]
        return data

    def interrupt(self) -> None:
        with contextlib.suppress(OSError):  # the socket may be closed
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._answer.close()
        self._socket.close()


def _parse_boundary(content_type: str) -> str:
    """The boundary of a stream's header without leading dashes. Servers give it with or without these, quoted or not,
    and with characters that should be quoted."""
    for part in content_type.split(";")[1:]:
        key, _, value = part.partition("=")
        if key.strip().lower() == "boundary":
            return value.strip().strip('"').strip().lstrip("-")
    return ""


class DeadlineSocket(socket.socket):
    """A socket that stops receiving at a deadline, even while single bytes arrive."""

    deadline = math.inf  # monotonic clock [s]

    def recv_into(self, *arguments: Any) -> int:
        remaining = self.deadline - time.monotonic()
        if remaining <= 0.0:
            raise TimeoutError("no complete frame arrived in time")
        self.settimeout(remaining)
        return super().recv_into(*arguments)


def _connect(url: str, description: str) -> DeadlineSocket:
    """Connects a socket, with the deadline for the header. Raises OSError, or WrongSource for a malformed address."""
    deadline = time.monotonic() + CONNECT_TIMEOUT
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port or 80
    except ValueError as error:
        raise WrongSource(f"{description}: not an address ({error})") from error
    if not host or parts.username is not None or not url.isascii() or not url.isprintable() or " " in url:
        raise WrongSource(
            f"{description}: an address has the form http://host:port/?action=stream (no user, no blanks)"
        )
    failure: OSError = TimeoutError(f"{description}: no answer")
    for family, kind, protocol, _, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
        connection = DeadlineSocket(family, kind, protocol)
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

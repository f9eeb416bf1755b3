"""The connection to one client of the mock, with its receive and send buffers."""

from __future__ import annotations

import socket
from collections import deque


class Connection:
    """A non-blocking socket with buffers.

    Replies wait until the client reads them. While data wait, stream packages are dropped: a slow client loses
    packages, but never gets a part of one.
    """

    def __init__(self, sock: socket.socket, port: int) -> None:
        send_buffer = (
            1 << 16
        )  # of the operating system; small, so that packages for a slow client are less than seconds old [bytes]
        self.socket, self.port = sock, port
        self.received = bytearray()
        self.searched = 0  # bytes at its front without the end of a program
        self.sent = self.dropped = 0  # stream packages
        self._late_size = 0
        self._late: deque[tuple[float, bytes, bool, bool]] = (
            deque()
        )  # (due, bytes, droppable, halved) of a slow connection
        self._waiting = bytearray()
        self._half = b""  # second part of a package that is sent in two parts
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, send_buffer)

    def read(self) -> bool:
        """Reads data that have arrived; returns False when the client is gone."""
        chunk = 1 << 16  # bytes read at a time
        try:
            data = self.socket.recv(chunk)
        except BlockingIOError:
            return True
        except OSError:
            return False
        self.received += data
        return bool(data)

    def send(self, data: bytes, *, droppable: bool = False, due: float = 0.0, halved: bool = False) -> None:
        """Sends now, or at the time `due` [s]: see `flush`. `halved`: the second half is sent at the next flush."""
        if due > 0.0 or self._late:
            self._late.append((due, data, droppable, halved))
            self._late_size += len(data)
            return
        self._push(data, droppable, halved)

    def flush(self, now: float) -> bool:
        """Sends data that are due; returns False if the client is gone or its buffers are too large."""
        max_late = 1 << 26  # delayed data, before the client is disconnected [bytes]
        max_backlog = 1 << 20  # replies that a client does not read, before it is disconnected [bytes]
        self._push(b"", False, False)
        while self._late and self._late[0][0] <= now:
            _, data, droppable, halved = self._late.popleft()
            self._late_size -= len(data)
            self._push(data, droppable, halved)
        return self._drain() and len(self._waiting) <= max_backlog and self._late_size <= max_late

    def close(self, *, reset: bool = False) -> None:
        """Ends the connection with FIN, or with RST if `reset`."""
        if reset:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # on, 0 s
        self.socket.close()

    def _push(self, data: bytes, droppable: bool, halved: bool) -> None:
        self._waiting += self._half
        self._half = b""
        if droppable:
            if self._waiting:
                self._drain()
            if self._waiting:
                self.dropped += 1
                return
            self.sent += 1
        if halved:
            data, self._half = data[: len(data) // 2], data[len(data) // 2 :]
        self._waiting += data
        self._drain()

    def _drain(self) -> bool:
        if not self._waiting:
            return True
        try:
            count = self.socket.send(self._waiting)
        except BlockingIOError:
            return True
        except OSError:
            self._waiting.clear()
            return False
        del self._waiting[:count]
        return True

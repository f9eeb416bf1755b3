"""Limits on ur_rtde after it has connected: it cannot reconnect, and it cannot block its process.

By the source of ur_rtde 1.6.5, `RTDEControlInterface` answers any failure of its connection, in the failing call and in
its receiving thread, with `reconnect()`: it connects to the dashboard, the script port and the RTDE again, uploads its
control script again, and sends the command again. That program moves the arm after the driver has reported a lost link,
and it has no watchdog. No option turns this off.
"""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType


@contextlib.contextmanager
def forbid_later_connections() -> Iterator[None]:
    """Connections made inside the block are the last of this process: after it the process cannot open a descriptor,
    not even in place of a closed one. The standard streams must be open."""
    # The lowest free descriptor: all below are in use, and all that the block opens lie above.
    limit = os.open(os.devnull, os.O_RDONLY)
    try:
        yield
        _set_no_delay(limit)
    finally:
        os.close(limit)
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, limit))


def _set_no_delay(min_descriptor: int) -> None:
    """Sets TCP_NODELAY on the sockets with descriptors above `min_descriptor`. ur_rtde sets it, but Boost then closes
    that socket and connects another. Without it a command may wait 40 ms for an acknowledgement."""
    for entry in Path("/proc/self/fd").iterdir():
        if int(entry.name) > min_descriptor:
            with contextlib.suppress(OSError):  # not a socket
                connection = socket.socket(fileno=int(entry.name))
                if connection.family in (socket.AF_INET, socket.AF_INET6):
                    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                connection.detach()


class TimeLimit:
    """The kernel ends this process if a block takes longer than `seconds`, even while a library holds the interpreter
    lock. A reusable context manager; only one may be active."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def __enter__(self) -> None:
        signal.setitimer(signal.ITIMER_REAL, self.seconds)

    def __exit__(
        self, kind: type[BaseException] | None, failure: BaseException | None, trace: TracebackType | None
    ) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def enable_time_limits() -> None:
    """Restores the default effect of SIGALRM, which a TimeLimit needs, if the parent ignores or blocks the signal."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGALRM})

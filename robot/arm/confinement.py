"""What ur_rtde may not do once it is connected: connect anew, or keep its process waiting.

By the source of ur_rtde 1.6.5, `RTDEControlInterface` answers any failure of its connection, in the call that meets it
as well as in its receiving thread, with `reconnect()`: new connections to the dashboard, the script port and the RTDE,
its control script uploaded anew, and the command sent again. That program moves the arm, after the driver has told that
the link is lost, and it has no watchdog. No option turns it off.
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
def last_connections() -> Iterator[None]:
    """Connections that are made inside are the last of this process: afterwards it can open no descriptor any more,
    not even in place of one that it closes. Needs standard streams that are open."""
    # The lowest free one: all below it are in use, and all that is opened inside lies above it.
    limit = os.open(os.devnull, os.O_RDONLY)
    try:
        yield
        _send_at_once(limit)
    finally:
        os.close(limit)
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, limit))


def _send_at_once(above: int) -> None:
    """Sets TCP_NODELAY on the sockets with descriptors above this one: ur_rtde does, but Boost then closes the socket
    and opens another one to connect. Without it a command may wait 40 ms for an acknowledgement."""
    for entry in Path("/proc/self/fd").iterdir():
        if int(entry.name) > above:
            with contextlib.suppress(OSError):  # no socket
                link = socket.socket(fileno=int(entry.name))
                if link.family in (socket.AF_INET, socket.AF_INET6):
                    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                link.detach()


class TimeLimit:
    """The kernel ends this process if a block takes longer than `seconds`, even while a library holds the interpreter.
    A context manager that can be used again; one at a time."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def __enter__(self) -> None:
        signal.setitimer(signal.ITIMER_REAL, self.seconds)

    def __exit__(
        self, kind: type[BaseException] | None, failure: BaseException | None, trace: TracebackType | None
    ) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def allow_time_limits() -> None:
    """Gives SIGALRM its default effect, also where the parent ignores or blocks it: what a time limit relies on."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGALRM})

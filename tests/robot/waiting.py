"""Helpers for tests of other processes: waiting, and a check whether a process runs."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

PATIENCE = 60.0  # for an event [s]


def until(
    done: Callable[[], bool],
    what: str = "what was waited for",
    pause: float = 1e-3,
    why: Callable[[], str] = str,
) -> float:
    """Waits; returns when it was seen to be so, by the monotonic clock [s]. `why` tells how things stand, if not."""
    deadline = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < deadline, f"{what}: not within {PATIENCE} s; {why()}"
        time.sleep(pause)
    return time.monotonic()


def alive(pid: int) -> bool:
    """False for a zombie, too: who reaps an orphan is not this project's matter."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False

"""A lock that one process holds on a file that it replaces again and again."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def hold_lock(path: Path) -> Iterator[None]:
    """Locks `path`, which need not exist, against other processes that lock it, until the context ends. What is locked
    is a hidden file next to it, since writing a file as a whole replaces it. Raises BlockingIOError if another process
    holds the lock, OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = path.with_name(f".{path.name}.lock")
    while True:
        with lock.open("ab") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not lock.exists() or os.fstat(file.fileno()).st_ino != lock.stat().st_ino:
                continue  # its last holder has removed it just now
            try:
                yield
            finally:
                lock.unlink(missing_ok=True)
            return

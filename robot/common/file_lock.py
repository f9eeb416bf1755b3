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
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as failure:
                raise OSError(failure.errno, failure.strerror, str(lock)) from None
            if not _is_at(file.fileno(), lock):
                continue  # its last holder has removed it just now
            try:
                yield
            finally:
                lock.unlink(missing_ok=True)
            return


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether the open file is the one that `path` names now."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False

"""A file that is whole or not there, whenever the process ends."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any


def write_whole(path: Path, content: bytes | Callable[[IO[bytes]], Any]) -> None:
    """Writes `content`, or what it writes into an open file, beside `path`, and puts it there once the disk has it.
    Makes the folder. Raises OSError that names the file."""
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("wb") as file:
            if isinstance(content, bytes):
                file.write(content)
            else:
                content(file)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except BaseException as failure:
        part.unlink(missing_ok=True)
        # torch turns a full disk into a RuntimeError of its own
        if not isinstance(failure, OSError | RuntimeError):
            raise
        why = failure.strerror if isinstance(failure, OSError) else str(failure).splitlines()[0]
        number = failure.errno if isinstance(failure, OSError) else None
        raise OSError(number or 5, f"cannot be written: {why}", str(path)) from failure

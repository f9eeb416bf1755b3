"""Files and folders that are either complete or absent, whenever the process ends."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any


def write_whole(path: Path, content: bytes | Callable[[IO[bytes]], Any]) -> None:
    """Writes a file next to `path` and moves it to `path` once it is on the disk. Makes the folder.

    content: bytes, or a function that writes into an open file. Raises OSError that names the file.
    """
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
        # torch raises RuntimeError for a full disk
        if not isinstance(failure, OSError | RuntimeError):
            raise
        why = failure.strerror if isinstance(failure, OSError) else str(failure).splitlines()[0]
        number = failure.errno if isinstance(failure, OSError) else None
        raise OSError(number or 5, f"cannot be written: {why}", str(path)) from failure


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Yields a temporary folder, which becomes the new folder `path` at the end of the block. It is deleted if the
    block raises. Raises FileExistsError if `path` was made by another process, OSError that names `path`."""
    home = next(place for place in path.absolute().parents if place.is_dir())
    part: Path | None = None
    try:
        part = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=home))
        yield part
        part.chmod(0o755)
        path.parent.mkdir(parents=True, exist_ok=True)
        part.rename(path)  # fails if `path` is a folder with files
    except BaseException as failure:
        if part is not None:
            shutil.rmtree(part, ignore_errors=True)
        if not isinstance(failure, OSError):
            raise
        if failure.errno in (errno.EEXIST, errno.ENOTEMPTY):
            raise FileExistsError(errno.EEXIST, "File exists", str(path)) from None
        if failure.filename is None or str(failure.filename).startswith(
            str(part)
        ):  # the error of a full disk names no file
            failure.filename, failure.filename2 = str(path), None
        raise


def move_to_new_path(part: Path, path: Path) -> None:
    """Moves the finished file `part` to `path`. Raises FileExistsError if `path` exists, OSError."""
    try:
        os.link(part, path)
    except FileExistsError:
        raise FileExistsError(errno.EEXIST, "File exists", str(path)) from None
    except OSError:  # this file system has no hard links
        if path.exists():
            raise FileExistsError(errno.EEXIST, "File exists", str(path)) from None
        part.rename(path)
    else:
        part.unlink()

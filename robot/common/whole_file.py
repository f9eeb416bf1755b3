"""A file, or a folder, that is whole or not there, whenever the process ends."""

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


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Gives a folder to write into, which becomes the new folder `path` at the end of the block, or is gone. Raises
    FileExistsError if somebody else has made it meanwhile, OSError that names `path`."""
    home = next(place for place in path.absolute().parents if place.is_dir())
    part: Path | None = None
    try:
        part = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=home))
        yield part
        part.chmod(0o755)
        path.parent.mkdir(parents=True, exist_ok=True)
        part.rename(path)  # onto an empty folder, or nothing: onto another it fails
    except BaseException as failure:
        if part is not None:
            shutil.rmtree(part, ignore_errors=True)
        if not isinstance(failure, OSError):
            raise
        if failure.errno in (errno.EEXIST, errno.ENOTEMPTY):
            raise FileExistsError(errno.EEXIST, "File exists", str(path)) from None
        if failure.filename is None or str(failure.filename).startswith(str(part)):  # a full disk does not say where
            failure.filename, failure.filename2 = str(path), None
        raise


def put_new(part: Path, path: Path) -> None:
    """Gives a finished file its name. Raises FileExistsError if there is one of that name already, OSError."""
    try:
        os.link(part, path)
    except FileExistsError:
        raise FileExistsError(errno.EEXIST, "File exists", str(path)) from None
    except OSError:  # no such links on this disk
        if path.exists():
            raise FileExistsError(errno.EEXIST, "File exists", str(path)) from None
        part.rename(path)
    else:
        part.unlink()

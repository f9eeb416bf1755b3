"""The folder of a set: its settings, its files, and the failures. If the process is killed at any time, all files are
complete, and the missing pieces are known."""

from __future__ import annotations

import fcntl
import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from robot.collect.workers import Job, Piece, SetError
from robot.common.whole_file import whole_folder, write_whole
from robot.deploy.control_loop import versions
from tacsim.models.text import printable_line

FORMAT = 2
SETTINGS_FILE, FAILURES, CARD = "collect.json", "failures.jsonl", "README.md"


class SetFolder:
    """One set. Open it with `open_set`."""

    def __init__(self, path: Path, job: Job) -> None:
        self.path, self._job = path, job
        self.failures = self._read_failures()
        self._done = {piece for piece in range(job.pieces) if self._is_done(piece)}
        finished = {index for piece in self._done for index in job.numbers(piece)}
        self.failures = {index: reason for index, reason in self.failures.items() if index in finished}

    @property
    def missing(self) -> list[int]:
        """Pieces that are not made yet."""
        return [piece for piece in range(self._job.pieces) if piece not in self._done]

    @property
    def done(self) -> int:
        """Presses or episodes that are made or have failed."""
        return sum(len(self._job.numbers(piece)) for piece in self._done)

    @property
    def files(self) -> list[Path]:
        """The files of the pieces, in order."""
        return [path for piece in sorted(self._done) if (path := self.path / self._job.name(piece)).exists()]

    def write_piece(self, piece: Piece) -> None:
        """Writes a piece completely or not at all. Raises OSError that names the file."""
        if piece.number in self._done:
            return
        if piece.failures:
            self.failures |= piece.failures
            lines = [json.dumps({"index": index, "reason": self.failures[index]}) for index in sorted(self.failures)]
            write_whole(self.path / FAILURES, "".join(f"{line}\n" for line in lines).encode())
        if piece.data is not None:
            write_whole(self.path / self._job.name(piece.number), piece.data)
        self._done.add(piece.number)

    def _is_done(self, piece: int) -> bool:
        made = (self.path / self._job.name(piece)).exists()
        return made or all(index in self.failures for index in self._job.numbers(piece))

    def _read_failures(self) -> dict[int, str]:
        path = self.path / FAILURES
        if not path.exists():
            return {}
        try:
            rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
            return {int(row["index"]): str(row["reason"]) for row in rows}
        except (ValueError, KeyError, TypeError):
            raise SetError(
                f"{path} cannot be read; delete it, then repeat the command to try the failed presses again"
            ) from None


@contextmanager
def open_set(
    path: Path, job: Job, settings: Mapping[str, Any], files: Mapping[str, bytes], command: str
) -> Iterator[SetFolder]:
    """Starts or continues a set, and locks its folder against other processes until the context ends.

    Args:
        settings: as JSON; they determine the set, except for its length.
        files: that the job also needs, by path in the folder.

    Raises:
        SetError: the folder holds something else than this set, or another process has locked it.
        OSError.
    """
    digests = {name: hashlib.sha256(data).hexdigest() for name, data in sorted(files.items())}
    about = {
        "format": FORMAT,
        "count": job.count,
        "command": command,
        "versions": versions(),
        "settings": dict(settings),
        "files": digests,
    }
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        _create_folder(path, about, files)
    with _lock_folder(path):
        before = _read_settings(path)
        _require_same(path, before, about)
        _require_whole(path, digests)
        if job.count > before["count"]:
            _extend_set(path, job, before, about)
        for part in path.rglob(".*.part"):
            part.unlink()
        yield SetFolder(path, job)


def _create_folder(path: Path, about: Mapping[str, Any], files: Mapping[str, bytes]) -> None:
    """Makes the folder with its settings and files, completely or not at all."""
    # another process may have made it first; the checks after opening compare the settings
    with suppress(FileExistsError), whole_folder(path) as partial:
        for name, data in {SETTINGS_FILE: _encode_settings(about), **files}.items():
            write_whole(partial / name, data)


def _encode_settings(about: Mapping[str, Any]) -> bytes:
    return (json.dumps(about, indent=1, allow_nan=False) + "\n").encode()


@contextmanager
def _lock_folder(path: Path) -> Iterator[None]:
    if not (path / SETTINGS_FILE).is_file():
        raise SetError(f"{path} exists, but holds no set (no {SETTINGS_FILE} in it); name a new folder")
    with (path / SETTINGS_FILE).open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise SetError(f"{path}: another tacsim collect works in this folder; wait for it, or end it") from None
        yield


def _read_settings(path: Path) -> dict[str, Any]:
    try:
        about: dict[str, Any] = json.loads((path / SETTINGS_FILE).read_text(encoding="utf-8"))
        if about["format"] != FORMAT:
            raise SetError(
                f"{path} has format {about['format']}, this tacsim continues format {FORMAT}; name a new folder"
            )
        return about | {"count": int(about["count"]), "settings": dict(about["settings"])}
    except (ValueError, KeyError, TypeError) as failure:
        if isinstance(failure, SetError):
            raise
        raise SetError(
            f"{path / SETTINGS_FILE} cannot be read: {printable_line(str(failure))}; name a new folder"
        ) from None


def _require_same(path: Path, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    max_listed = 6  # differences between two commands in the message
    old, new = (
        _flatten_mapping(json.loads(_encode_settings({**about["settings"], "files": about["files"]})))
        for about in (before, now)
    )
    wrong = [
        f"{key} is {_format_value(old.get(key))} there and {_format_value(new.get(key))} here"
        for key in {**old, **new}
        if old.get(key) != new.get(key)
    ]
    if len(wrong) > max_listed:
        wrong[max_listed:] = [f"{len(wrong) - max_listed} more differ"]
    if now["count"] < before["count"]:
        wrong.append(f"its count is {before['count']}, the requested count is {now['count']}")
    versions = (about["versions"].get("tacsim") for about in (before, now))
    first, second = (each or "unknown" for each in versions)
    if first != second:
        wrong.append(f"it was started by tacsim {first}, this is {second}")
    if wrong:
        raise SetError(
            f"{path} holds a set by another command ({printable_line(str(before['command']))}): {'; '.join(wrong)}. "
            "Give that command again to continue the set, or name a new folder"
        )


def _flatten_mapping(value: Any, at: str = "") -> dict[str, Any]:
    """The values of nested mappings, by dotted path."""
    if not isinstance(value, dict) or not value:
        return {at: value}
    return {
        path: leaf
        for key, each in value.items()
        for path, leaf in _flatten_mapping(each, f"{at}.{key}".strip(".")).items()
    }


def _format_value(value: Any) -> str:
    return printable_line(json.dumps(value), 80)


def _require_whole(path: Path, digests: Mapping[str, str]) -> None:
    for name, digest in digests.items():
        file = path / name
        if not file.is_file() or hashlib.sha256(file.read_bytes()).hexdigest() != digest:
            raise SetError(f"{file} was removed or changed since the set was started; name a new folder")


def _extend_set(path: Path, job: Job, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Deletes the last file if it needs more rows, then writes the new length."""
    last = next((piece for piece in range(job.pieces) if job.numbers(piece)[-1] >= before["count"]), None)
    if last is not None and job.numbers(last)[0] < before["count"]:
        (path / job.name(last)).unlink(missing_ok=True)
    with (path / SETTINGS_FILE).open("r+b") as file:  # the same file: it is locked
        text = _encode_settings({**before, "count": now["count"], "command": now["command"]})
        file.write(text)
        file.truncate()

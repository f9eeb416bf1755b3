"""The folder of a set: what it is a function of, its files, and what failed. Killed anywhere, it holds whole files of
whole pieces, and what is missing is known."""

from __future__ import annotations

import fcntl
import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from robot.collect.job import Job, Piece, SetError
from robot.common.whole_file import whole_folder, write_whole
from robot.deploy.control_loop import versions
from tacsim.models.text import printable_line

FORMAT = 2
ABOUT, FAILURES, CARD = "collect.json", "failures.jsonl", "README.md"


class SetFolder:
    """One set. Open it with `open_set`."""

    def __init__(self, path: Path, job: Job) -> None:
        self.path, self._job = path, job
        self.failures = self._read_failures()
        self._done = {piece for piece in range(job.pieces) if self._is_done(piece)}
        kept = {index for piece in self._done for index in job.numbers(piece)}
        self.failures = {index: why for index, why in self.failures.items() if index in kept}

    @property
    def missing(self) -> list[int]:
        """Pieces that nobody has made."""
        return [piece for piece in range(self._job.pieces) if piece not in self._done]

    @property
    def done(self) -> int:
        """Presses or episodes that are made or have failed."""
        return sum(len(self._job.numbers(piece)) for piece in self._done)

    @property
    def files(self) -> list[Path]:
        """Those of pieces, in their order."""
        return [path for piece in sorted(self._done) if (path := self.path / self._job.name(piece)).exists()]

    def put(self, piece: Piece) -> None:
        """Writes a piece: all of it or nothing. Raises OSError that names the file."""
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
            raise SetError(f"{path} cannot be read; delete it, and what failed is tried again") from None


@contextmanager
def open_set(
    path: Path, job: Job, settings: Mapping[str, Any], files: Mapping[str, bytes], command: str
) -> Iterator[SetFolder]:
    """Begins a set, or goes on with it; nobody else can meanwhile.

    settings: as JSON, all that the set is a function of but its length. files: what is needed besides, by place in the
    folder. Raises SetError for a folder with anything else than this set, or that somebody else works on; OSError.
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
        _begin(path, about, files)
    with _alone(path):
        before = _read(path)
        _require_same(path, before, about)
        _require_whole(path, digests)
        if job.count > before["count"]:
            _lengthen(path, job, before, about)
        for part in path.rglob(".*.part"):
            part.unlink()
        yield SetFolder(path, job)


def _begin(path: Path, about: Mapping[str, Any], files: Mapping[str, bytes]) -> None:
    """All of it, or nothing."""
    with suppress(FileExistsError), whole_folder(path) as partial:  # whoever was faster began it: seen as it is opened
        for name, data in {ABOUT: _text(about), **files}.items():
            write_whole(partial / name, data)


def _text(about: Mapping[str, Any]) -> bytes:
    return (json.dumps(about, indent=1, allow_nan=False) + "\n").encode()


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    if not (path / ABOUT).is_file():
        raise SetError(f"{path} exists and holds no set that was begun (no {ABOUT} in it); name a new folder")
    with (path / ABOUT).open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise SetError(f"{path}: another tacsim collect is at work on it; wait for it, or end it") from None
        yield


def _read(path: Path) -> dict[str, Any]:
    try:
        about: dict[str, Any] = json.loads((path / ABOUT).read_text(encoding="utf-8"))
        if about["format"] != FORMAT:
            raise SetError(f"{path} has format {about['format']}, this tacsim goes on with {FORMAT}; name a new folder")
        return about | {"count": int(about["count"]), "settings": dict(about["settings"])}
    except (ValueError, KeyError, TypeError) as failure:
        if isinstance(failure, SetError):
            raise
        raise SetError(f"{path / ABOUT} cannot be read: {printable_line(str(failure))}; name a new folder") from None


def _require_same(path: Path, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    max_shown = 6  # differences between two commands that are told
    old, new = (_leaves(json.loads(_text({**about["settings"], "files": about["files"]}))) for about in (before, now))
    wrong = [f"{key} is {_short(old.get(key))} there and {_short(new.get(key))} here" for key in {**old, **new}
             if old.get(key) != new.get(key)]  # fmt: skip
    if len(wrong) > max_shown:
        wrong[max_shown:] = [f"{len(wrong) - max_shown} more differ"]
    if now["count"] < before["count"]:
        wrong.append(f"it has {before['count']} already begun, {now['count']} are asked for")
    versions = (about["versions"].get("tacsim") for about in (before, now))
    first, second = (each or "unknown" for each in versions)
    if first != second:
        wrong.append(f"it was begun by tacsim {first}, this is {second}")
    if wrong:
        raise SetError(
            f"{path} holds a set by another command ({printable_line(str(before['command']))}): {'; '.join(wrong)}. "
            "Give that command again to go on with it, or name a new folder"
        )


def _leaves(value: Any, at: str = "") -> dict[str, Any]:
    """What is in nested mappings, by path."""
    if not isinstance(value, dict) or not value:
        return {at: value}
    return {path: leaf for key, each in value.items() for path, leaf in _leaves(each, f"{at}.{key}".strip(".")).items()}


def _short(value: Any) -> str:
    return printable_line(json.dumps(value), 80)


def _require_whole(path: Path, digests: Mapping[str, str]) -> None:
    for name, digest in digests.items():
        file = path / name
        if not file.is_file() or hashlib.sha256(file.read_bytes()).hexdigest() != digest:
            raise SetError(f"{file} was removed or changed since the set was begun; name a new folder")


def _lengthen(path: Path, job: Job, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Drops the last file where it gets more rows, then notes the new length."""
    last = next((piece for piece in range(job.pieces) if job.numbers(piece)[-1] >= before["count"]), None)
    if last is not None and job.numbers(last)[0] < before["count"]:
        (path / job.name(last)).unlink(missing_ok=True)
    with (path / ABOUT).open("r+b") as file:  # the same file: it is locked
        text = _text({**before, "count": now["count"], "command": now["command"]})
        file.write(text)
        file.truncate()

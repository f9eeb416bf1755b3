"""Hashes of documents and files. A document is hashed as canonical JSON: sorted keys, no spaces, UTF-8."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any


def canonical_json(document: Any) -> bytes:
    """The one text of a document of dictionaries, lists, texts and finite numbers. Raises ValueError for NaN."""
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.encode()


def hash_document(document: Any) -> str:
    """SHA-256 of its canonical JSON, in hexadecimal digits."""
    return hashlib.sha256(canonical_json(document)).hexdigest()


def hash_file(path: Path) -> str:
    """SHA-256 of a file. Raises OSError."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def hash_files(root: Path, paths: Iterable[Path]) -> str:
    """SHA-256 of files below `root`, with their paths; line ends do not matter."""
    digest = hashlib.sha256()
    for path in sorted(paths):
        content = path.read_bytes().replace(b"\r\n", b"\n")
        digest.update(f"{path.relative_to(root).as_posix()}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()


def uniform_numbers(key: str, count: int) -> list[float]:
    """`count` numbers in [-1, 1) that follow from the text `key` alone: SHA-256 in counter mode. The random streams of
    a library may change with its version; these do not."""
    numbers: list[float] = []
    block = 0
    while len(numbers) < count:
        data = hashlib.sha256(f"{key}:{block}".encode()).digest()
        numbers += [int.from_bytes(data[at : at + 4], "big") / 2**31 - 1.0 for at in range(0, len(data), 4)]
        block += 1
    return numbers[:count]

"""Numbers that are long to compute and belong to one version of the physics: kept in the user's cache folder."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path


def cached(name: str, question: str, compute: Callable[[], list[float]]) -> list[float]:
    """What `compute` gave when `question` was last asked of this version of the physics, else what it gives now.

    A cache that cannot be read or written is no error: the numbers are then computed each time.
    """
    path = folder() / f"{name}-{_key(question)}.json"
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(kept, list) and kept and all(isinstance(value, float) for value in kept):
            return kept
    except (OSError, ValueError):
        pass
    numbers = compute()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(numbers), encoding="utf-8")
    except OSError:
        pass
    return numbers


def folder() -> Path:
    """The user's cache folder for benchmarks."""
    if sys.platform == "win32":
        root = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    elif sys.platform == "darwin":
        root = Path.home() / "Library" / "Caches"
    else:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return root / "tacsim" / "bench"


def fingerprint(*packages: str) -> str:
    """Changes with every source file of the packages, by name and content."""
    digest = hashlib.sha256()
    for package in packages:
        (folder,) = import_module(package).__path__
        for source in sorted(Path(folder).rglob("*.py")):
            digest.update(source.relative_to(folder).as_posix().encode() + source.read_bytes())
    return digest.hexdigest()


def _key(question: str) -> str:
    return hashlib.sha256((question + fingerprint("tacsim.physics")).encode()).hexdigest()[:16]

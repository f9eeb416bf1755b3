"""Configuration files that tests write."""

from __future__ import annotations

from pathlib import Path


def write(path: str, text: str) -> str:
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(text, encoding="utf-8")
    return path

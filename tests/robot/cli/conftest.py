"""Fixtures of the tests of the command."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest


@pytest.fixture
def empty_folder(empty_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder that a command runs in, and a terminal that does not break lines."""
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("TERM", "dumb")
    monkeypatch.setattr(sys, "path", list(sys.path))  # `tacsim run` adds the folder

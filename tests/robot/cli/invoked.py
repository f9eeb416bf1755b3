"""The `tacsim` command, called in this process or started in another."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from typer.testing import CliRunner, Result

from robot.cli import app

TINY = ("--set", "scene.particle_spacing=1 mm", "--set", "scene.element_size=2 mm")  # a world of seconds
START = (sys.executable, "-c", "from robot.cli import main; main()")


def tacsim(*words: object, **environment: str) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "200", **environment})


def plain_text(output: str) -> str:
    """Without the frame and line breaks of an error's box."""
    return " ".join(output.replace("│", " ").split())


def environment() -> dict[str, str]:
    """So that a process started elsewhere finds the packages."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[3]), *sys.path])}

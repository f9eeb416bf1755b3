"""Small sets: two objects at preset learn, some milliseconds a press."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import parquet

from robot.collect.presses import PressJob, PressSet
from tacsim.config import load_scene, load_sensor
from tacsim.models.scene import Box, Sphere

OBJECTS = {"ball": Sphere(radius=3e-3), "cube": Box(size=(4e-3, 5e-3, 5e-3))}


def settings(**more: Any) -> PressSet:
    given: dict[str, Any] = {
        "objects": OBJECTS,
        "scene": load_scene("press", ["preset=learn"]),
        "sensor": load_sensor("ideal"),
        "depth": (0.2e-3, 0.6e-3),
        "tilt": (0.0, 0.05),
        "per_file": 2,
        **more,
    }
    return PressSet(**given)


def job(count: int = 5, **more: Any) -> PressJob:
    return PressJob(settings(**more), count)


def contents(folder: Path) -> dict[str, bytes]:
    """Of all files of a set but its own notes."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in ("collect.json", "README.md")
    }


def rows(folder: Path) -> list[dict[str, Any]]:
    tables = [parquet.read_table(path) for path in sorted((folder / "data").glob("train-*.parquet"))]
    found: list[dict[str, Any]] = pa.concat_tables(tables).to_pylist()
    return found

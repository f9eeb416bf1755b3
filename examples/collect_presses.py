"""Collect labelled presses of a user-defined shape in parquet, stop half-way, and continue to the same set.

python examples/collect_presses.py      # needs the extra `export`
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import trimesh
from pyarrow import dataset

TACSIM = Path(sys.executable).with_name("tacsim")
COMMAND = ["collect", "press", "--depth", "0.2..0.6mm", "--pose", "centred", "--preset", "learn", "--workers", "1"]


def collect(objects: Path, folder: Path, count: int) -> None:
    """Makes the presses that the set still lacks."""
    arguments = [*COMMAND, "--objects", str(objects), "--count", str(count), "--out", str(folder)]
    done = subprocess.run([str(TACSIM), *arguments], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"tacsim {' '.join(arguments)} ended with {done.returncode}:\n{done.stdout}{done.stderr}")


def read(folder: Path) -> list[dict[str, Any]]:
    """The presses of the set, in order: depth [m], force [N], area of contact [m^2]."""
    table = dataset.dataset(folder / "data").to_table(columns=["index", "depth", "normal_force", "contact_area"])
    return sorted(table.to_pylist(), key=lambda press: press["index"])


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        objects, folder = Path(name) / "objects", Path(name) / "presses"
        objects.mkdir()
        trimesh.creation.capsule(height=4.0, radius=2.0, count=[8, 8]).export(objects / "capsule.stl")  # [mm]
        collect(objects, folder, 1)
        first = read(folder)
        collect(objects, folder, 3)  # continues: the first press is kept
        presses = read(folder)
    for press in presses:
        print(f"press {press['index']}: {press['depth'] * 1e3:.2f} mm deep, {press['normal_force']:.3f} N")

    if len(presses) != 3 or presses[:1] != first:
        sys.exit(f"the set has {len(presses)} presses, not 3, or its first one has changed: {first}, {presses}")
    by_depth = sorted(presses, key=lambda press: press["depth"])
    if by_depth != sorted(presses, key=lambda press: press["normal_force"]):
        sys.exit("the force on an upright capsule does not grow with its depth")


if __name__ == "__main__":
    main()

"""Collect labelled presses of many shapes in parquet, stop half-way, and continue to the same files.

python examples/collect_presses.py      # needs the extra `export`
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from pyarrow import dataset

TACSIM = Path(sys.executable).with_name("tacsim")
COMMAND = ["collect", "press", "--objects", "shapes", "--depth", "0.2..0.6mm", "--preset", "learn", "--workers", "1"]


def collect(folder: Path, count: int) -> None:
    """Makes the presses that the set still lacks."""
    arguments = [*COMMAND, "--count", str(count), "--out", str(folder)]
    done = subprocess.run([str(TACSIM), *arguments], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"tacsim {' '.join(arguments)} ended with {done.returncode}:\n{done.stdout}{done.stderr}")


def read(folder: Path) -> dict[str, list[float]]:
    """The columns of the set that are compared here."""
    table = dataset.dataset(folder / "data").to_table(columns=["index", "depth", "normal_force", "contact_area"])
    columns: dict[str, list[float]] = table.to_pydict()
    return columns


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        whole, resumed = Path(name) / "whole", Path(name) / "resumed"
        collect(whole, 4)
        collect(resumed, 2)
        collect(resumed, 4)  # continues: the first two are kept
        once, twice = read(whole), read(resumed)
    for index, depth, force in zip(once["index"], once["depth"], once["normal_force"], strict=True):
        print(f"press {index}: {depth * 1e3:.2f} mm deep, {force:.3f} N")

    if once["index"] != [0, 1, 2, 3] or min(once["normal_force"]) <= 0 or min(once["contact_area"]) <= 0:
        sys.exit(f"the set lacks presses, or one of them has no contact: {once}")
    if once != twice:
        sys.exit("the resumed set differs from the one that was made at once")


if __name__ == "__main__":
    main()

"""Tuned constants: where they stand, and that each says what it is."""

from __future__ import annotations

import ast
import itertools
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TREES = {
    path: ast.parse(path.read_text(encoding="utf-8"), str(path))
    for package in ("tacsim", "calibration", "robot")
    for path in sorted((ROOT / package).rglob("*.py"))
}
PHYSICS_ROOMS = ("grip", "pads", "worlds", "motion", "contact", "body", "gel", "failure", "seed")
UNTUNED = {  # sizes of arrays, properties of a formula, and sentinels: they stand beside the code that they belong to
    "UNREACHABLE_LIMIT", "UNKNOWN_DISTANCE", "POINTS", "SPLINE_SMOOTHING", "QUANTITIES", "LATTICE_ROWS",
    "PEAK_SLOPE", "PEAK_BRAKING", "PAD", "SWEEPS", "STAGES", "BLOCKS", "MOTION",
    "FRAME_ROWS", "PATCH_MOMENTS", "MAX_WEIGHT_SUM",
}  # fmt: skip


def numeric_constants(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Name and line of each UPPER_CASE name that a module binds to a number or a tuple of numbers."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and re.fullmatch(r"[-\d.e+*/ (),x]+", ast.unparse(node.value)):
            names = {name.id for target in node.targets for name in ast.walk(target) if isinstance(name, ast.Name)}
            yield from ((name, node.lineno) for name in names if re.fullmatch(r"_?[A-Z][A-Z\d_]*", name))


def test_tuned_constants_of_physics_stand_in_the_tuning_file_of_their_room() -> None:
    found = {
        f"{path.relative_to(ROOT)}: {constant}"
        for path, tree in TREES.items()
        if path.parent.parent == ROOT / "tacsim/physics" and path.parent.name in PHYSICS_ROOMS
        if path.name != "tuning.py"
        for constant, _ in numeric_constants(tree)
        if constant not in UNTUNED
    }
    assert found == set()


def test_each_tuned_constant_says_what_it_is() -> None:
    """On its own line or above it; a comment above may hold for the constants that follow it."""
    files = [path for path in TREES if path.name == "tuning.py"]
    assert len(files) > 15
    for path in files:
        lines = path.read_text(encoding="utf-8").splitlines()
        for constant, line in numeric_constants(TREES[path]):
            above = itertools.takewhile(bool, reversed(lines[: line - 1]))
            assert "  # " in lines[line - 1] or any(text.startswith("# ") for text in above), f"{path}: {constant}"

"""Each program in examples/ runs in a fresh process, as a user starts it, and its own check passes."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples"
MODULES = {"stretch.py"}  # imported by the command (docs/tasks.md, tests/docs/test_examples.py); no program
PROGRAMS = sorted(path for path in EXAMPLES.glob("*.py") if path.name not in MODULES)
README = (ROOT / "README.md").read_text(encoding="utf-8")
MAX_LINES = 60
LIMIT = 240.0  # only against hanging, on a machine with other work [s]


def run(program: Path, folder: Path) -> subprocess.CompletedProcess[str]:
    """The finished process of a program that was started in `folder`."""
    environment = {**os.environ, "TACSIM_THREADS": "1", "MPLBACKEND": "Agg"}
    return subprocess.run(
        [sys.executable, str(program)], cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT
    )


@pytest.mark.slow
@pytest.mark.timeout(LIMIT + 30)
@pytest.mark.parametrize("program", PROGRAMS, ids=lambda path: path.stem)
def test_program_passes_its_own_check(program: Path, tmp_path: Path) -> None:
    done = run(program, tmp_path)
    assert done.returncode == 0, f"{program.name} ends with {done.returncode}:\n{done.stdout}{done.stderr}"
    assert done.stdout, "it shows nothing"
    assert list(tmp_path.iterdir()) == [], "it leaves files in the folder where it runs"


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda path: path.stem)
def test_program_is_short_and_ends_with_a_check(program: Path) -> None:
    text = program.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= MAX_LINES
    tree = ast.parse(text)
    (main,) = (node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "main")
    last = main.body[-1]
    assert isinstance(last, ast.If | ast.For) and "sys.exit(" in ast.unparse(last)
    assert f"python examples/{program.name}" in (ast.get_docstring(tree) or "")


def test_readme_lists_every_program_in_one_line() -> None:
    listed = re.findall(r"^\| \[`(\w+\.py)`\]\(examples/(\w+\.py)\) \| \S.* \|$", README, re.MULTILINE)
    assert sorted(name for name, _ in listed) == sorted(path.name for path in EXAMPLES.glob("*.py"))
    assert all(name == target for name, target in listed)


def test_there_are_examples_of_the_uses() -> None:
    assert len(PROGRAMS) >= 8


def test_programs_use_public_names() -> None:
    """What they import stands in tests/api_surface.json, so that a user may copy it."""
    private = [
        f"{program.name}: {node.module}"
        for program in PROGRAMS
        for node in ast.walk(ast.parse(program.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom)
        and re.match(r"(tacsim|calibration|robot)\.", str(node.module))
        and node.module != "robot.mock"
    ]
    assert private == []

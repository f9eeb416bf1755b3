"""Builds the distributions of tacsim and of its plug-ins, and uses their wheels in clean environments.

    python tools/install_matrix.py --python python3.11 --python python3.12 --python python3.13

Each wheel is built from its source distribution. For each Python: a new virtual environment outside the checkout, the
wheel of tacsim with the newest dependencies that pip finds, then `tacsim doctor`, `run` and `replay`. A plug-in is
installed by each Python that it allows, without its dependencies: LeRobot is large. Exit code 1 if anything failed.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PIP = ("-m", "pip", "--quiet", "--no-input", "--disable-pip-version-check")
COMMANDS = (  # the default job of `make run`, and its report again
    ("doctor",),
    ("run", "--out", "first"),
    ("replay", "first/episode.mcap", "--out", "again"),
)


@dataclass(frozen=True, slots=True)
class Row:
    """What was tried with one wheel and one Python."""

    python: str
    wheel: str
    step: str
    seconds: float
    result: str  # "ok", or the end of the output

    @property
    def is_ok(self) -> bool:
        return self.result == "ok"


def build_distributions(folder: Path, python: str) -> None:
    """Builds source distribution and wheel (from it) of tacsim and of each plug-in into `folder`. Raises
    CalledProcessError."""
    with tempfile.TemporaryDirectory() as place:
        builder = _new_environment(Path(place) / "build", python)
        subprocess.run([builder, *PIP, "install", "build"], check=True)
        for project in (ROOT, *sorted(path.parent for path in ROOT.glob("plugins/*/pyproject.toml"))):
            _report(f"building {project.name}")
            subprocess.run([builder, "-m", "build", "--outdir", folder, project], check=True, stdout=subprocess.DEVNULL)


def try_wheels(wheels: Sequence[Path], python: str) -> list[Row]:
    """Installs and uses the wheels by one Python, in an environment and a folder of their own."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        version = _output([python, "-c", "import platform; print(platform.python_version())"])
        interpreter = _new_environment(folder / "environment", python)
        tacsim, *plugins = sorted(wheels, key=lambda wheel: not wheel.name.startswith("tacsim-"))

        def attempt(wheel: Path, step: str, command: Sequence[str | Path]) -> bool:
            _report(f"Python {version}: {wheel.name.partition('-')[0]}: {step}")
            begun = time.monotonic()
            done = subprocess.run(command, cwd=folder, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
            result = "ok" if done.returncode == 0 else f"exit code {done.returncode}: {done.stdout.strip()[-300:]}"
            rows.append(Row(version, wheel.name.partition("-")[0], step, time.monotonic() - begun, result))
            return rows[-1].is_ok

        if attempt(tacsim, "install", [interpreter, *PIP, "install", tacsim]):
            for words in COMMANDS:
                attempt(tacsim, f"tacsim {words[0]}", [interpreter.parent / "tacsim", *words])
        for wheel in plugins:
            if _allows(wheel, version):
                attempt(wheel, "install", [interpreter, *PIP, "install", "--no-deps", wheel])
    return rows


def _allows(wheel: Path, version: str) -> bool:
    """Whether the plug-in of a wheel allows a version of Python, such as ">=3.12,<3.13"."""
    name = wheel.name.partition("-")[0]
    project = tomllib.loads((ROOT / "plugins" / name / "pyproject.toml").read_text("utf-8"))["project"]
    low, high = (part.strip().lstrip("<>=") for part in project["requires-python"].split(","))
    return _numbers(low) <= _numbers(version) < _numbers(high)


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(map(int, version.split(".")))


def _new_environment(folder: Path, python: str) -> Path:
    """Its interpreter."""
    subprocess.run([python, "-m", "venv", folder], check=True)
    return folder / ("Scripts" if sys.platform == "win32" else "bin") / "python"


def _output(command: Sequence[str]) -> str:
    return subprocess.run(command, check=True, text=True, stdout=subprocess.PIPE).stdout.strip()


def _report(words: str) -> None:
    sys.stderr.write(f"{words}\n")


def main() -> None:
    """Builds, unless --dist holds wheels; prints the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--python", action="append", metavar="COMMAND", help="may be repeated; default: this one")
    parser.add_argument("--dist", type=Path, help="folder of the distributions; those in it are used")
    options = parser.parse_args()
    pythons: list[str] = options.python or [sys.executable]
    missing = [python for python in pythons if shutil.which(python) is None]
    if missing:
        parser.error(f"not found: {', '.join(missing)}; install it, or leave out its --python")
    with tempfile.TemporaryDirectory() as place:
        folder = (Path(place) if options.dist is None else options.dist).resolve()
        if not list(folder.glob("tacsim-*.whl")):
            build_distributions(folder, pythons[0])
        wheels = sorted(folder.glob("*.whl"))
        if len({wheel.name.partition("-")[0] for wheel in wheels}) < len(wheels):
            parser.error(f"{folder} holds several wheels of one distribution; name a new folder by --dist")
        rows = [row for python in pythons for row in try_wheels(wheels, python)]
    sys.stdout.write("| Python | wheel | step | time [s] | result |\n|---|---|---|---|---|\n")
    for row in rows:
        sys.stdout.write(f"| {row.python} | {row.wheel} | {row.step} | {row.seconds:.0f} | {row.result} |\n")
    raise SystemExit(0 if all(row.is_ok for row in rows) else 1)


if __name__ == "__main__":
    main()

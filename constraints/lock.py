"""Pins the whole environment (core and dev) for the Python that runs this: `make lock` calls it once per Python.

pip itself resolves, so the pins are what `pip install '.[dev]'` would choose today. Only names and versions are
written: where packages come from is each machine's own affair.
"""

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent


def resolve(project: Path) -> dict[str, str]:
    """Normalised name -> version of everything that pip would install into an empty environment."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        command += ["--dry-run", "--ignore-installed", "--report", str(report), f"{project}[dev]"]
        subprocess.run(command, check=True)
        installs = json.loads(report.read_text(encoding="utf-8"))["install"]
    found = {re.sub(r"[-_.]+", "-", item["metadata"]["name"]).lower(): item["metadata"]["version"] for item in installs}
    del found["tacsim"]
    return found


def main() -> None:
    pins = resolve(HERE.parent)
    name = f"py{sys.version_info.major}{sys.version_info.minor}.txt"
    lines = [f"# Made by `make lock` with Python {sys.version_info.major}.{sys.version_info.minor} on {sys.platform}."]
    lines += [f"{package}=={version}" for package, version in sorted(pins.items())]
    (HERE / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
    sys.stdout.write(f"constraints/{name}: {len(pins)} packages\n")


if __name__ == "__main__":
    main()

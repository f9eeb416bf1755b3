"""Describe a scene in a YAML file with units, change single values, and read the error for a mistake.

python examples/configure_scene.py
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from tacsim import ConfigError, Cylinder, Scene, load_scene

SCENE = """\
extends: squeeze
preset: learn
body:
  geometry: {shape: cylinder, radius: 4 mm, height: 8 mm}
  material: dough
"""


def load(folder: Path, text: str, *changes: str) -> Scene:
    """The scene of a file with this text, with changes as `--set` on the command line has them."""
    path = folder / "mine.yaml"
    path.write_text(text)
    return load_scene(path, changes)


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        scene = load(Path(name), SCENE, "friction.upper=0.3", "gel.material.youngs_modulus=0.2 MPa")
        error = ""
        try:
            load(Path(name), SCENE + "frictoin: {upper: 0.3}\n")
        except ConfigError as mistake:
            error = str(mistake)
    print(f"body {scene.body.geometry}, friction {scene.friction}, gel {scene.gel.material.youngs_modulus:.3g} Pa")
    print(error)

    if scene.body.geometry != Cylinder(radius=4e-3, height=8e-3) or scene.gel.material.youngs_modulus != 0.2e6:
        sys.exit(f"the scene has other values than its file: {scene}")
    if scene.friction != {"lower": 0.6, "upper": 0.3}:
        sys.exit(f"a value that the file does not change is not the shipped one: {scene.friction}")
    if "mine.yaml:6" not in error or "did you mean 'friction'" not in error:
        sys.exit(f"the error does not name the line and the nearest key: {error}")


if __name__ == "__main__":
    main()

"""Identify the stiffness of a gel from a table of presses: where the ball was, and the force that was measured.

    python examples/identify_gel.py

The measurement is simulated here, with a stiffness that `tacsim identify` does not know and a noise of the force.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from robot import PressMotion, press
from tacsim import load_scene, load_sensor

TACSIM = Path(sys.executable).with_name("tacsim")
HIDDEN = 0.19e6  # Young's modulus of the gel [Pa]
DEPTHS = [0.2e-3, 0.4e-3, 0.6e-3]  # of the ball's lowest point [m]
NOISE = 0.01  # of the force sensor [N]


def measure(table: Path) -> None:
    """Writes the places of the ball's lowest point [m] and the forces on the sensor [N]."""
    scene = load_scene("press", ["preset=learn", f"gel.material.youngs_modulus={HIDDEN}"])
    random, rows = np.random.default_rng(0), ["x,y,z,fz", "0,0,0.001,0"]
    for depth in DEPTHS:
        force = press(scene, load_sensor("ideal"), PressMotion(depth=depth)).wrench[2] + random.normal(0, NOISE)
        rows.append(f"0,0,{-depth},{force:.4f}")
    table.write_text("\n".join(rows) + "\n")


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        table, out = Path(name) / "presses.csv", Path(name) / "gel"
        measure(table)
        options = ["--fit", "youngs_modulus", "--preset", "learn", "--force-noise", f"{NOISE} N", "--out", str(out)]
        command = [str(TACSIM), "identify", "gel", str(table), *options]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            sys.exit(f"tacsim identify ended with {done.returncode}:\n{done.stdout}{done.stderr}")
        found = json.loads((out / "identified.json").read_text())["parameters"]["youngs_modulus"]
    print(f"Young's modulus {found['value']:.3g} Pa, 95 % from {found['low']:.3g} to {found['high']:.3g}")

    if abs(found["value"] / HIDDEN - 1) > 0.05 or not found["low"] < HIDDEN < found["high"]:
        sys.exit(f"the hidden Young's modulus is {HIDDEN:.3g} Pa: more than 5 % off, or outside the interval")


if __name__ == "__main__":
    main()

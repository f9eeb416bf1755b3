"""Squeeze plasticine between two gels that differ: the softer one is pressed deeper, and both feel the same force.

python examples/two_gels.py
"""

from __future__ import annotations

import sys

import numpy as np

from robot import open_rig
from tacsim import Action, Pose

SETTINGS = [
    "scene.preset=learn",
    "scene.gels={upper: {material: {youngs_modulus: 0.08 MPa}}}",  # the lower gel has 0.145 MPa
]
STEP = np.array([0.0, 0.0, 0.1e-3])  # of each sensor in a control period [m]


def main() -> None:
    with open_rig("sim", overrides=SETTINGS) as rig:
        observation = rig.reset(seed=0)
        for _ in range(6):
            lower, upper = (observation.arms[name].pose for name in ("lower", "upper"))
            closer = {
                "lower": Pose(lower.position + STEP, lower.quaternion),
                "upper": Pose(upper.position - STEP, upper.quaternion),
            }
            observation, _ = rig.step(Action(closer))

    depths, forces = {}, {}
    for name, touch in observation.tactile.items():
        if touch.height is None:
            sys.exit(f"sensor {name} has no height map, but a simulated sensor always has one")
        depths[name] = float(touch.height.max())
        forces[name] = -observation.arms[name].wrench[2]
        print(f"{name}: force {forces[name]:.2f} N, deepest {depths[name] * 1e3:.3f} mm")

    if not depths["upper"] > 1.2 * depths["lower"]:
        sys.exit("the softer upper gel is not pressed deeper than the lower one")
    if abs(forces["upper"] / forces["lower"] - 1) > 0.03:
        sys.exit("the two gels do not feel the same force, though the body between them is at rest")


if __name__ == "__main__":
    main()

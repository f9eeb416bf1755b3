"""Hold a constant normal force while a sensor slides over a body, and watch the friction.

python examples/hold_force.py
"""

from __future__ import annotations

import sys

import numpy as np

from tacsim import Pose, load_scene, make_world

LOAD, FRICTION = 1.0, 0.4  # normal force [N], coefficient between the body and each gel
SLIDE = 2.0e-3  # of the upper sensor along x, in STEPS motions [m]
STEPS = 5


def main() -> None:
    scene = load_scene("squeeze", ["preset=learn", f"friction={{lower: 2, upper: {FRICTION}}}"])
    world = make_world(scene)
    world.move({}, loads={"upper": LOAD})  # closes until the force is reached
    drags, forces = [], []
    for _ in range(STEPS):
        pose = world.pose("upper")
        target = Pose(pose.position + np.array([SLIDE / STEPS, 0.0, 0.0]), pose.quaternion)
        stats = world.move({"upper": target}, loads={"upper": LOAD})
        wrench = world.wrench("upper")  # what the body does to the sensor, sensor axes
        forces.append(-wrench[2])
        drags.append(float(np.hypot(*wrench[:2])))
        print(f"force {forces[-1]:.3f} N, drag {drags[-1]:.3f} N, settled: {stats.settled}")

    if max(abs(force / LOAD - 1) for force in forces) > 0.02:
        sys.exit(f"the normal force left {LOAD} N by more than 2 %: {forces}")
    if any(drag > 1.02 * FRICTION * force for drag, force in zip(drags, forces, strict=True)):
        sys.exit(f"a drag exceeds Coulomb's limit, {FRICTION} times the normal force: {drags}")
    if drags[-1] < 0.8 * FRICTION * LOAD:
        sys.exit(f"the sensor slid {SLIDE * 1e3} mm, but the drag is only {drags[-1]:.3f} N")


if __name__ == "__main__":
    main()

"""The picture of docs/grippers.md: `python -m benchmarks.cell_picture docs/images/grippers.jpg`."""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt

from robot.open import open_rig
from tacsim.interface import Action, GripperTarget, Observation, Pose
from tacsim.rig import Rig

LIFT = 0.03  # [m]
CLOSE = "cameras.close={position: [0.1, -0.2, 0.13], target: [0, 0, 0.075], field_of_view: 32 deg, size: [480, 480]}"
FRONT = "cameras.front={position: [0.55, -0.8, 0.6], target: [-0.2, 0, 0.24], field_of_view: 45 deg, size: [480, 480]}"


def lift(rig: Rig, force: float) -> Observation:
    """Grips what stands between the fingers, and lifts it."""
    start = rig.reset().arms["hand"].pose
    for _ in range(8):
        rig.step(Action({}, {"hand": GripperTarget(0.0, force)}))
    steps = 16
    for number in range(1, steps + 1):
        up = Pose(start.position + [0.0, 0.0, LIFT * number / steps], start.quaternion)
        seen, _ = rig.step(Action({"hand": up}))
    return seen


def draw(path: Path) -> None:
    with open_rig("ur5e-mujoco", overrides=(FRONT,)) as rig:
        arm = lift(rig, 20.0).views["front"].image
    ball = "scene.object.geometry={shape: sphere, radius: 10 mm}"
    bare = "task=null", "scene=hold", "scene.preset=draft"
    sensors = [f"sensors.{side}.model=gelsight-mini" for side in ("left", "right")]
    with open_rig("hand", overrides=(*bare, CLOSE, ball, "scene.object.mass=0.2", *sensors)) as rig:
        held = lift(rig, 5.0)
        hand, touch = held.views["close"].image, held.tactile["left"].picture
    assert touch is not None
    figure, axes = plt.subplots(1, 3, figsize=(13, 4.2), layout="constrained", width_ratios=(1, 1, 1.33))
    titles = "ur5e-mujoco: a box, lifted", "hand: a ball of 0.2 kg, 5 N", "what the left gel sees"
    for axis, picture, title in zip(axes, (arm, hand, touch), titles, strict=True):
        axis.imshow(picture)
        axis.set_title(title)
        axis.set_axis_off()
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))

"""Films of the tasks for a gripper: `python -m benchmarks.gripper_film turn turn.gif [key=value ...]`.

Each frame has the scene, the picture of the left gel (its change since the reference), the flow of its markers, and
grip force and distance so far. A film that ends in .jpg is a strip of some frames.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from PIL import Image as Picture

from robot.open import load_with_task, open_rig
from tacsim.interface import Image, Observation, Truth
from tacsim.sim.cell.cell import grip_pose
from tacsim.tasks import Task, make_task

CAMERA = (0.12, -0.22, 0.07)  # from where the object is gripped [m]
SENSORS = tuple(f"sensors.{side}.model={{extends: gelsight-mini, markers: {{}}}}" for side in ("left", "right"))
FLOW_SCALE = 5.0  # arrows are so many times as long as the displacements
STRIP = 3
LARGEST_DISTANCE = 10.0  # that is drawn, over what counts as reached


def close_camera(name: str, overrides: Sequence[str]) -> str:
    """The setting of a camera that looks at where the object is gripped."""
    scene = load_with_task("hand", name, overrides).config.scene
    assert scene is not None
    target = grip_pose(scene).position
    words = [[round(float(each), 4) for each in place] for place in (target + CAMERA, target)]
    return f"cameras.close={{position: {words[0]}, target: {words[1]}, field_of_view: 30 deg, size: [360, 360]}}"


def play(name: str, overrides: Sequence[str]) -> tuple[Task, list[Observation], list[Truth]]:
    """An episode of the scripted policy on the rig `hand`, in dynamic motion."""
    loaded = load_with_task("hand", name, ["scene.preset=learn", close_camera(name, overrides), *overrides])
    assert loaded.config.task is not None
    task = make_task(loaded.config.task)
    with open_rig(loaded) as rig:
        observation, policy = rig.reset(), task.scripted()
        policy.reset()
        observed, truths = [], []
        for _ in range(task.config.steps + 1):
            truth = rig.truth()
            assert truth is not None
            _ = observation.views["close"].image, observation.tactile["left"].image  # rendered now: the scene moves on
            observed.append(observation)
            truths.append(truth)
            observation, _ = rig.step(policy(observation))
    return task, observed, truths


def draw_frame(task: Task, observed: Sequence[Observation], truths: Sequence[Truth], number: int) -> Image:
    figure, axes = plt.subplots(1, 4, figsize=(11, 2.9), dpi=80, layout="constrained")
    touch = observed[number].tactile["left"]
    axes[0].imshow(observed[number].views["close"].image)
    axes[1].imshow(touch.image)
    for axis, title in zip(axes, (f"step {number}", "left gel, change", "flow of its markers, x 5"), strict=False):
        axis.set_title(title, fontsize=9)
        axis.set_axis_off()
    if touch.flow is not None:
        rows, columns = touch.flow.shape[:2]
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        arrows = FLOW_SCALE * 1e3 * touch.flow  # about a millimetre from marker to marker
        axes[2].quiver(x, y, arrows[..., 0], arrows[..., 1], angles="xy", scale_units="xy", scale=1.0, width=5e-3)
        axes[2].set(xlim=(-1, columns), ylim=(rows, -1), aspect="equal")
    draw_curves(axes[3], task, observed, truths, number)
    buffer = BytesIO()
    figure.savefig(buffer)
    plt.close(figure)
    return np.asarray(Picture.open(buffer).convert("RGB"))


def draw_curves(axes: Axes, task: Task, observed: Sequence[Observation], truths: Sequence[Truth], number: int) -> None:
    unit = task.config.unit
    forces = [float(each.grippers["hand"].force or 0.0) for each in observed[: number + 1]]
    distances = [unit.factor * task.distance(truth, truths[0]) for truth in truths[: number + 1]]
    axes.plot(forces, color="#1f3a5f")
    axes.set(xlim=(0, len(observed)), ylim=(0, 1.1 * task.config.touch_force), xlabel="step")
    axes.set_ylabel("grip force [N]", color="#1f3a5f", fontsize=8)
    other = axes.twinx()
    other.plot(distances, color="#c0572b")
    highest = max(task.distance(truth, truths[0]) for truth in truths)
    other.axhline(unit.factor * task.config.success, color="#c0572b", linewidth=0.8, linestyle="--")  # reached below it
    other.set(ylim=(0, 1.1 * unit.factor * min(highest, LARGEST_DISTANCE * task.config.success)))
    other.set_ylabel(f"distance [{unit.symbol}]", color="#c0572b", fontsize=8)


def write(path: Path, task: Task, observed: Sequence[Observation], truths: Sequence[Truth]) -> None:
    if path.suffix == ".jpg":
        chosen = np.linspace(len(observed) / 5, len(observed) - 1, STRIP).astype(int)
        frames = [draw_frame(task, observed, truths, number) for number in chosen]
        Picture.fromarray(np.concatenate(frames)).save(path, quality=85)
        return
    frames = [draw_frame(task, observed, truths, number) for number in range(0, len(observed), 2)]
    first, *others = (Picture.fromarray(frame).quantize(128) for frame in frames)
    first.save(path, save_all=True, append_images=others, duration=100, loop=0, optimize=True)


if __name__ == "__main__":
    write(Path(sys.argv[2]), *play(sys.argv[1], sys.argv[3:]))

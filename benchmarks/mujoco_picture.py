"""The picture of docs/mujoco.md: `MUJOCO_GL=egl python -m benchmarks.mujoco_picture docs/images/mujoco.png`."""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import mujoco
import numpy as np

from benchmarks.mujoco_touch import FRICTION, Grip
from tacsim.config import load_sensor
from tacsim.interface import FloatArray, Image
from tacsim.models.scene import GelSurface
from tacsim.optics.render import Renderer

MASS, GRIP = 0.2, 4.0  # [kg], [N]


def record() -> tuple[FloatArray, GelSurface, Image]:
    """Rows of time, grip force, shear in world z, slip share and lag of the object; the left pad's surface and the view
    while it is held."""
    grip = Grip("box", MASS, preset="draft")
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = [0, 0, 0], 0.11, 120, -20
    rows, held, view = list[list[float]](), None, None
    grip.close(GRIP)
    for now in grip.run(0.65, force=lambda now: GRIP * min(1.0, 1.0 - 0.8 * (now - 0.15) / 0.4)):
        if now > 0.1 and held is None:
            held, view = grip.touch.surface("left"), render(grip, camera)
        used = grip.touch.slip_share("left")
        rows.append([now, -grip.touch.wrenches[0, 2], grip.touch.world_forces[:, 2].sum(), used, grip.place[0]])
        if grip.place[0] - rows[0][4] > 3e-3:
            break
    assert held is not None and view is not None
    return np.array(rows), held, view


def render(grip: Grip, camera: mujoco.MjvCamera) -> Image:
    with mujoco.Renderer(grip.model, 360, 360) as renderer:
        renderer.update_scene(grip.data, camera)
        return np.asarray(renderer.render())


def draw(path: Path) -> None:
    rows, surface, view = record()
    figure, axes = plt.subplots(1, 4, figsize=(14, 3.4), width_ratios=(1, 1.3, 1.1, 1.5), layout="constrained")
    axes[0].imshow(view)
    axes[0].set_title("MuJoCo: a box of 0.2 kg, held")
    sensor = load_sensor("ideal-markers")
    axes[1].imshow(Renderer(sensor, (20e-3, 20e-3))(surface))
    axes[1].set_title("picture of the left pad")
    for each in axes[:2]:
        each.set_axis_off()
    moved = surface.displacement * 1e3
    x, y = (o * 1e3 + surface.spacing * 1e3 * np.arange(n) for o, n in zip(surface.origin, moved.shape, strict=False))
    shown = axes[2].pcolormesh(x, y, -moved[..., 2].T, cmap="magma", shading="gouraud")
    axes[2].quiver(x, y, moved[..., 0].T, moved[..., 1].T, color="w", angles="xy", scale_units="xy", scale=0.12)
    axes[2].set_aspect("equal")
    axes[2].invert_yaxis()
    axes[2].set_title("its height [mm] and shear")
    figure.colorbar(shown, ax=axes[2])
    time = rows[:, 0]
    axes[3].plot(time, rows[:, 1], label="grip of a pad [N]")
    axes[3].plot(time, -rows[:, 2], label="shear of both pads [N]")
    axes[3].plot(time, 2 * FRICTION * rows[:, 1], "--", lw=1, label="limit of friction [N]")
    axes[3].axhline(MASS * 9.81, color="k", lw=0.7, label="weight [N]")
    axes[3].plot(time, (rows[:, 4] - rows[0, 4]) * 1e3, label="slip [mm]")
    axes[3].set_xlabel("time [s]")
    axes[3].legend(fontsize=7)
    axes[3].set_title("a falling grip")
    figure.savefig(path, dpi=90)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))

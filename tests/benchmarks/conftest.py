"""Made-up frames of a ball's press with known truth. The dent is the FFT layer's, not the one the fit assumes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from benchmarks.cases.press import solve_layer

PITCH = 0.0625e-3  # of image and FFT grid alike [m]
SIZE = 200  # px


def dented(
    ball: float, depth: float, centre: tuple[float, float], thickness: float = 10e-3
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], float]:
    """Image, image without contact, true contact radius [px]; ball, depth, thickness [m], centre x, y [px]."""

    def gap(r: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(r < ball, ball - np.sqrt(np.maximum(ball**2 - r**2, 0)), 1.0)

    contact = solve_layer(gap, depth, 0.48, thickness=thickness)
    truth = float(np.sqrt((contact.pressure > 0).sum() / np.pi))
    by_x, by_y = np.gradient(contact.displacement, PITCH)
    x, y = (256 - round(c) for c in centre)
    seen = [slope.T[y : y + SIZE, x : x + SIZE] for slope in (by_x, by_y)]
    light = np.array([[1.0, 0.1], [-0.5, 0.8], [-0.4, -0.9]])
    rng = np.random.default_rng(1)
    base = np.linspace([100, 130, 90], [140, 100, 120], SIZE)[None, :, :].repeat(SIZE, axis=0)
    change = 90 * np.tanh(1.5 * np.einsum("cd,dyx->yxc", light, np.array(seen)))  # saturates, as real light does
    images = [np.clip(base + part + rng.normal(0, 2, base.shape), 0, 255).astype(np.uint8) for part in (change, 0)]
    return images[0], images[1], truth


LABELS = """\
name: made up
pixel_pitch: 0.0625 mm
gel_size: [14 mm, 14 mm]
gel_thickness: [4 mm, 3 mm]
depth_uncertainty: 0.05 mm
backgrounds: [none.png, ../empty.png]
presses:
  - {{ frames: [nowhere.png, ball_a.png], ball_radius: 3 mm, depth: 0.5 mm, radius_px: {radius:g} }}
  - {{ ball_radius: 3 mm, depth: 0.25 mm, radius_px: 14 }}
"""


@pytest.fixture
def folder_of_frames(tmp_path: Path) -> tuple[Path, float]:
    """A folder with labels, a frame and an empty frame; and the true contact radius [px]."""
    image, empty, truth = dented(3e-3, 0.5e-3, (90, 110), 4e-3)
    root = tmp_path / "frames"
    (root / "deep" / "presses").mkdir(parents=True)
    Image.fromarray(image).save(root / "deep" / "presses" / "ball_a.png")
    Image.fromarray(empty).save(root / "deep" / "empty.png")
    (root / "presses.yaml").write_text(LABELS.format(radius=truth), encoding="utf-8")
    return root, truth

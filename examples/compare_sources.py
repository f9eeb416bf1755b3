"""Compare a simulated sensor with a real one: how alike are their pictures in contact?

    python examples/compare_sources.py

Every error is reported with the *null*, the error of a picture without contact. Here the real sensor is simulated too,
with camera noise; one simulation of it has the right light, another draws no contact at all.
"""

from __future__ import annotations

import sys

import numpy as np

from calibration import Comparison, Frame, FrameSet, compare_frames
from robot import PressMotion, press
from tacsim import Renderer, load_scene, load_sensor, make_world

PLACES = [(-3, -2), (3, -2), (-3, 2), (3, 2)]  # of the presses, x and y [mm]
DEPTH = 0.5e-3  # [m]


def main() -> None:
    scene = load_scene("press", ["preset=draft"])
    sensor = load_sensor("ideal", ["geometry={width: 200, height: 150, pixel_pitch: 0.1 mm}"])
    render, random = Renderer(sensor, scene.gel.size[:2]), np.random.default_rng(0)
    untouched = render(make_world(scene).surface("lower"))
    motions = [PressMotion(depth=DEPTH, at=(x * 1e-3, y * 1e-3)) for x, y in PLACES]
    pressed = [press(scene, sensor, motion, render).image for motion in motions]

    def frames(name: str, images: list[np.ndarray], noise: float) -> FrameSet:
        """A reference and presses, as `read_frame_set` reads them from a folder of pictures."""

        def photograph(image: np.ndarray) -> np.ndarray:
            return np.clip(np.rint(image + random.normal(0, noise, image.shape)), 0, 255).astype(np.uint8)

        shots = tuple(Frame(f"press_{k}", photograph(image)) for k, image in enumerate(images))
        return FrameSet(name, photograph(untouched), "first picture", shots)

    real = frames("real", pressed, noise=1.5)
    good: Comparison = compare_frames(frames("right light", pressed, noise=1.5), real)
    blank: Comparison = compare_frames(frames("no contact", [untouched] * len(pressed), noise=0.0), real)
    for compared in (good, blank):
        error = compared.overall["contact_mae"]
        print(f"{compared.a.name}: contact MAE {error.mean:.1f} grey levels, null {error.null:.1f}")

    if not good.overall["contact_mae"].outperforms_null:
        sys.exit("the simulation with the right light is not better than a picture without contact")
    if blank.overall["contact_mae"].outperforms_null:
        sys.exit("a simulation that draws no contact counts as better than a picture without contact")


if __name__ == "__main__":
    main()

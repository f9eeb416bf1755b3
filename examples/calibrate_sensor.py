"""Calibrate a sensor's light from a few presses of a ball, then measure depth in a picture that took no part.

    python examples/calibrate_sensor.py

The pictures are simulated here. Replace them with those of your sensor, or use `tacsim calibrate sensor FOLDER`.
"""

from __future__ import annotations

import sys

import numpy as np

from calibration import calibrate_light, normaliser_for_calibration
from robot import PressMotion, PressResult, press
from tacsim import CanonicalGrid, Renderer, TactileFrame, load_scene, load_sensor, make_world

RADIUS = 4e-3  # of the ball [m]
PLACES = [(-4, -3, 0.4), (4, -3, 0.5), (-4, 3, 0.6), (4, 3, 0.45), (0, 0, 0.55)]  # x, y, depth [mm]
HELD_OUT = (1.5, -1.0, 0.5)


def main() -> None:
    scene = load_scene("press", ["preset=draft", f"indenter.geometry.radius={RADIUS} m"])
    sensor = load_sensor("ideal", ["geometry={width: 128, height: 96, pixel_pitch: 0.15 mm}"])
    render, random = Renderer(sensor, scene.gel.size[:2]), np.random.default_rng(0)

    def photograph(image: np.ndarray) -> np.ndarray:
        """The picture with the noise of a camera."""
        return np.clip(np.rint(image + random.normal(0, 1.0, image.shape)), 0, 255).astype(np.uint8)

    def pressed(x: float, y: float, depth: float) -> PressResult:
        return press(scene, sensor, PressMotion(depth=depth * 1e-3, at=(x * 1e-3, y * 1e-3)), render)

    reference = photograph(render(make_world(scene).surface("lower")))
    frames = [(f"press_{k}", photograph(pressed(*place).image)) for k, place in enumerate(PLACES)]
    fit = calibrate_light(reference, frames, RADIUS / sensor.geometry.pixel_pitch)
    calibration = fit.to_calibration("example", RADIUS, sensor.geometry.pixel_pitch)

    normalise = normaliser_for_calibration(calibration, CanonicalGrid())
    truth = pressed(*HELD_OUT)
    normalise.take_reference(TactileFrame(reference, time=0.0, index=0))
    found = normalise(TactileFrame(photograph(truth.image), time=0.1, index=1), 0.1).height
    depth, expected = float(found.max()), float(truth.height.max())
    print(f"deepest in the picture {depth * 1e3:.3f} mm, in the simulation {expected * 1e3:.3f} mm")
    if abs(depth / expected - 1) > 0.1:
        sys.exit("the depth that the calibrated sensor measures is more than 10 % off")


if __name__ == "__main__":
    main()

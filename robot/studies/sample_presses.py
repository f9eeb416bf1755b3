"""Sample presses of a ball, to try `tacsim calibrate sensor` and `tacsim compare` without a sensor.

The simulator draws them, always the same ones: the pictures of a DIGIT whose camera has noise, and those of a
coarser simulation of it without noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from robot.studies.press import PressMotion, press
from tacsim.config import load_scene, load_sensor
from tacsim.config.gel import fit_gel
from tacsim.interface import Image
from tacsim.models.sensor import CameraNoise, SensorModel
from tacsim.optics.noise import NoiseSource
from tacsim.optics.render import Renderer
from tacsim.physics.worlds.press import PressWorld

SENSOR = "digit"
BALL_RADIUS = 3e-3  # [m]
UNTOUCHED_COUNT = 4  # pictures without contact; their differences give the camera's noise
# place x, y of the ball on the gel and depth of the press [mm]: all over the picture, at different depths
PRESSES = (
    (-2.4, -3.8, 0.5),
    (2.2, -4.0, 0.7),
    (0.0, -1.2, 0.6),
    (-2.6, 1.0, 0.8),
    (2.5, 1.2, 0.9),
    (0.0, 3.6, 0.65),
    (-1.9, 4.2, 0.85),
    (2.3, 4.3, 0.75),
)
SERIES = ("sensor", "simulation")  # the names of both series
NOISE = CameraNoise(deviation=(1.5, 1.2, 1.5), neighbours=(0.3, 0.3))  # less than a real DIGIT has


def draw_samples(on_press: Callable[[int, int], None] = lambda done, total: None) -> Iterator[tuple[str, Image]]:
    """Path without suffix and RGB picture of each sample; `on_press` gets the number of finished presses and of all."""
    model, total = load_sensor(SENSOR), len(SERIES) * len(PRESSES)
    for series, preset in enumerate(("standard", "draft")):
        folder, has_noise = SERIES[series], series == 0
        scene, _ = fit_gel(
            load_scene("press", [f"preset={preset}", f"indenter.geometry={{shape: sphere, radius: {BALL_RADIUS} m}}"]),
            {"lower": model},
        )
        render = Renderer(model, scene.gel.size[:2])
        noise = NoiseSource(NOISE, model.image_shape) if has_noise else None
        untouched = render(PressWorld(scene).surface("lower"))
        for frame in range(UNTOUCHED_COUNT if has_noise else 1):
            image = untouched if noise is None else noise(untouched, frame)
            yield f"{folder}/background{f'_{frame + 1}' if frame else ''}", image
        for number, (x, y, depth) in enumerate(PRESSES):
            on_press(series * len(PRESSES) + number, total)
            image = press(scene, model, PressMotion(depth * 1e-3, at=(x * 1e-3, y * 1e-3)), render).image
            yield (
                f"{folder}/press_{number}",
                image if noise is None else noise(image, UNTOUCHED_COUNT + number),
            )
    on_press(total, total)


def sample_lengths(model: SensorModel) -> dict[str, object]:
    """The true lengths of the samples, in SI units."""
    return {
        "sensor": model.name,
        "ball_radius": BALL_RADIUS,
        "pixel_pitch": model.geometry.pixel_pitch,
        "presses": [
            {"frame": f"press_{number}.png", "centre": [x * 1e-3, y * 1e-3], "depth": depth * 1e-3}
            for number, (x, y, depth) in enumerate(PRESSES)
        ],
    }

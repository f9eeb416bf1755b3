"""Real group: contact radius of balls on a real sensor against the simulated gel, with frames of the user.

Two comparisons for each press. `image`: the real frame against our rendered one, with circles by the same fit
(`calibration/light/dent.py`). `pressure`: the radius of the simulated contact itself, against the radius in the
labels.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.cases.press import press, solve_layer
from benchmarks.cases.real.labels import BadData, PressLabels, read_frames, read_labels
from benchmarks.harness.measure import Measurement, timed
from benchmarks.harness.runner import Case
from calibration.light.dent import NoCircle, find_contact_circle
from tacsim.interface import FloatArray, Image, Pose
from tacsim.models.material import GelMaterial
from tacsim.models.scene import Gel, Indenter, Scene, Settling, Sphere
from tacsim.physics.move import MoveStats
from tacsim.physics.world import World, make_world

ELEMENT = 0.5e-3  # [m]
LAYER_PIXELS = 512
CASE = "contact_radius"


def contact_radius(folder: Path, ball: float, thickness: float, element: float, repeat: int) -> list[Measurement]:
    """Balls pressed to the depths of real presses: contact radius, simulated against real."""
    labels = read_labels(folder)
    background, frames = read_frames(folder, labels)
    scene = ball_scene((*labels.gel_size, thickness), ball, element)
    press(ball_scene((*labels.gel_size, 2e-3), ball, 1e-3), 0.05e-3)  # compiles
    world = make_world(scene)
    camera = RenderedSensor(labels, background)
    before = camera.render_image(world)
    rows = []
    for at in sorted((p for p in labels.presses if p.ball_radius == ball), key=lambda p: p.depth):
        timing, stats = timed(partial(press_to, world, ball, at.depth), 1, warm=lambda: None)
        pressed = pressed_radius(world) / labels.pixel_pitch
        figures = {
            "ball_radius_mm": ball * 1e3,
            "depth_mm": at.depth * 1e3,
            "thickness_mm": thickness * 1e3,
            "depth_uncertainty_mm": labels.depth_uncertainty * 1e3,
            "pressure_px": pressed,
            **{f"{name}_px": value / labels.pixel_pitch for name, value in theories(ball, at.depth, thickness).items()},
        }
        note = "" if stats.settled else "not settled"
        if at in frames:
            real = camera.radius(frames[at], background, ball, f"the real frame of {at.name}")
            ours = camera.radius(camera.render_image(world), before, ball, f"our image of {at.name}")
            figures |= {"real_px": real, "image_px": ours}
            rows.append(
                Measurement(
                    timing, abs(ours - real), "px", "the real frame, circle by the same fit", f"{at.name}: image",
                    stats.substeps, figures, note,
                )
            )  # fmt: skip
        if at.radius_px is not None:
            rows.append(
                Measurement(
                    timing, abs(pressed - at.radius_px), "px", "contact radius in the labels", f"{at.name}: pressure",
                    stats.substeps, {**figures, "label_px": at.radius_px}, note,
                )
            )  # fmt: skip
    return rows


def ball_scene(gel_size: tuple[float, float, float], ball: float, element: float) -> Scene:
    """The default gel with another size, under a ball [m]."""
    return Scene(
        body=None,
        indenter=Indenter(geometry=Sphere(radius=ball)),
        gel=Gel(size=gel_size),
        element_size=element,
        settling=Settling(mach=0.05),
    )


def press_to(world: World, ball: float, depth: float) -> MoveStats:
    """Moves the ball's tip to `depth` below the untouched gel [m]."""
    pose = world.pose("indenter")
    return world.move({"indenter": Pose(np.array([*pose.position[:2], ball - depth]), pose.quaternion)})


def pressed_radius(world: World) -> float:
    """Radius of a ball's contact [m]: that of the Hertz pressure with the same second moment, a^2 = 5/2 <r^2>.

    r is that of the deformed surface. The area is no good measure, because single quadrature points may lose contact
    inside it. The radius differs from that of the FFT layer's area by at most 0.3 px of 0.06 mm, at 1 mm depth.
    """
    from tacsim.optics.spline import displacement_and_jacobian

    surface = world.surface("lower")
    pressure = world.snapshot()["pressure"].astype(np.float64)
    nodes = surface.displacement.shape[:2]
    lines = [
        start + (np.arange(count) + 0.5) * (n - 1) * surface.spacing / count
        for start, n, count in zip(surface.origin, nodes, pressure.shape, strict=True)
    ]
    points = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 2)
    displacement, _ = displacement_and_jacobian(surface, points)
    away = points + displacement[:, :2] - world.pose("indenter").position[:2]
    weight = pressure.ravel()
    if not weight.sum() > 0:
        raise RuntimeError("the ball does not touch the gel")
    return float(np.sqrt(2.5 * (weight * (away**2).sum(axis=1)).sum() / weight.sum()))


def theories(ball: float, depth: float, thickness: float) -> dict[str, float]:
    """Contact radius [m] by other methods: the cap of a ball below the rest plane (images made from a depth map), Hertz
    on a half-space, and the FFT layer."""

    def gap(r: FloatArray) -> FloatArray:
        return np.where(r < ball, ball - np.sqrt(np.maximum(ball**2 - r**2, 0.0)), 1.0)

    contact = solve_layer(gap, depth, GelMaterial().poisson_ratio, LAYER_PIXELS, thickness)
    return {
        "cap": float(np.sqrt(2 * ball * depth - depth**2)),
        "hertz": float(np.sqrt(ball * depth)),
        "layer": float(np.sqrt((contact.pressure > 0).sum() / np.pi)) * contact.pixel,
    }


class RenderedSensor:
    """Renders the gel with the size and pixel pitch of the real image, and finds circles in such images."""

    def __init__(self, labels: PressLabels, like: Image) -> None:
        from tacsim.models.sensor import SensorGeometry, SensorModel
        from tacsim.optics.render import Renderer

        rows, columns, _ = like.shape
        geometry = SensorGeometry(width=columns, height=rows, pixel_pitch=labels.pixel_pitch)
        self._pitch = labels.pixel_pitch
        self._render = Renderer(SensorModel(geometry=geometry), labels.gel_size)

    def render_image(self, world: World) -> Image:
        return self._render(world.surface("lower"))

    def radius(self, image: Image, background: Image, ball: float, what: str) -> float:
        """Contact radius [px]. Raises BadData that names the image without contact."""
        try:
            return find_contact_circle(image, background, ball / self._pitch).radius
        except NoCircle as error:
            raise BadData(f"{what}: {error}") from None


def cases(folder: Path) -> tuple[Case, ...]:
    """A case for each ball and gel. Raises BadData, ConfigError."""
    labels = read_labels(folder)
    read_frames(folder, labels)  # raises errors before the first press
    return tuple(
        Case(
            "real", CASE, "tacsim", f"ball R {ball * 1e3:g} mm, gel {thickness * 1e3:g} mm, h {ELEMENT * 1e3:g} mm",
            partial(contact_radius, folder, ball, thickness, ELEMENT), long=thickness != labels.gel_thickness[0],
        )
        for thickness in labels.gel_thickness
        for ball in labels.balls
    )  # fmt: skip

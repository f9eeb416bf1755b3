"""Simulated presses that match real frames: the same ball, in the same places, until the contact is as wide.

A whole simulation, mechanics and light, can so be compared with frames of which nothing else is known. The depth is
chosen by the width of the contact: the comparison judges shape and colour of a press, not its force or depth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.errors import BadFrames
from calibration.frame_set import Frame, FrameSet
from calibration.light.circle import Circle, NoCircle, contact_circle
from tacsim.interface import Pose, SurfaceMap
from tacsim.models.scene import GelSurface, Scene, Sphere
from tacsim.models.sensor import CanonicalGrid, SensorModel
from tacsim.optics.render import Renderer
from tacsim.optics.surface import surface_map
from tacsim.physics.world import World, make_world

Image = NDArray[np.uint8]

RADIUS_TOLERANCE = 0.25  # the contact is as wide as the real one when its radius differs by no more [px]
MAX_ATTEMPTS = 4  # presses that look for the depth
MAX_DEPTH = 0.8  # of the gel's thickness


def match_presses(
    real: FrameSet,
    scene: Scene,
    sensor: SensorModel,
    grid: CanonicalGrid,
    on_press: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[FrameSet, list[str]]:
    """The frames of `real` by the simulator, under the same names; and in words what could not be done.

    Args:
        real: frames of a ball's presses.
        scene: with that ball as its indenter.
        sensor: makes the pictures, of the size of the real ones: that of the sensor's calibration.
        grid: on which the surfaces are kept.

    Raises BadFrames for a scene without ball, pictures of another size, or no contact at all; SimulationDiverged.
    """
    if scene.indenter is None or not isinstance(scene.indenter.geometry, Sphere):
        raise BadFrames(f"scene '{scene.name}' presses no ball; what it presses is placed by the circle of a ball")
    if real.shape != (sensor.geometry.height, sensor.geometry.width):
        raise BadFrames(
            f"{real.name} is {real.shape[1]} x {real.shape[0]} px, the calibration is of "
            f"{sensor.geometry.width} x {sensor.geometry.height}; it belongs to another sensor or setting"
        )
    ball = scene.indenter.geometry.radius
    circles, notes = _circles(real, ball / sensor.geometry.pixel_pitch)
    gel = _PressedGel(scene, ball, sensor, grid)
    done: dict[str, Frame] = {}
    # in the order of the depths the gel is only ever pressed farther: it does not peel off the ball
    for name, circle in sorted(circles.items(), key=lambda item: item[1].radius):
        on_press(len(done), len(circles))
        image, surface, warning = gel.press(circle)
        done[name] = Frame(name, image, surface)
        notes += [f"{name}: {warning}"] if warning else []
    untouched = gel.untouched
    frames = tuple(done.get(frame.name, Frame(frame.name, *untouched)) for frame in real.frames)
    return FrameSet(f"scene {scene.name}", untouched[0], "the untouched simulated gel", frames), notes


class _PressedGel:
    """One gel under a ball. It is pressed in the middle and its surface moved under the camera: what happens near the
    border of a gel is not told."""

    def __init__(self, scene: Scene, ball: float, sensor: SensorModel, grid: CanonicalGrid) -> None:
        self.ball, self._sensor, self._grid = ball, sensor, grid
        self._world: World = make_world(scene)
        self._deepest = MAX_DEPTH * scene.gel.size[2]
        self._render = Renderer(sensor, scene.gel.size[:2])
        self.untouched = self._seen(0.0, 0.0)

    def press(self, circle: Circle) -> tuple[Image, SurfaceMap, str]:
        """Picture and surface of a press with this contact circle [px]; and a word if it did not come out."""
        pitch = self._sensor.geometry.pixel_pitch
        u0, v0 = self._sensor.geometry.principal
        x, y = (circle.x - u0) * pitch, (circle.y - v0) * pitch
        depth = (circle.radius * pitch) ** 2 / self.ball  # Hertz
        for _ in range(MAX_ATTEMPTS):
            stats = self._press_to(min(depth, self._deepest))
            image, surface = self._seen(x, y)
            try:
                radius = contact_circle(image, self.untouched[0], self.ball / pitch).radius
            except NoCircle as error:
                return image, surface, f"our own picture: {error}"
            if abs(radius - circle.radius) <= RADIUS_TOLERANCE:
                return image, surface, "" if stats else "not settled; raise settling.max_substeps"
            if depth > self._deepest:
                break
            depth *= (circle.radius / radius) ** 2
        return image, surface, f"the contact is {radius - circle.radius:+.1f} px wider than the real one"

    def _press_to(self, depth: float) -> bool:
        """Moves the ball to this depth [m]; True if the gel came to rest."""
        pose = self._world.pose("indenter")
        target = Pose(np.array([*pose.position[:2], self.ball - depth]), pose.quaternion)
        return self._world.move({"indenter": target}).settled

    def _seen(self, x: float, y: float) -> tuple[Image, SurfaceMap]:
        surface = self._world.surface("lower")
        at: GelSurface = replace(surface, origin=(surface.origin[0] + x, surface.origin[1] + y))
        return self._render(at), surface_map(at, self._grid, self._sensor.markers)


def _circles(real: FrameSet, ball: float) -> tuple[dict[str, Circle], list[str]]:
    """Contact circles by the frame's name, and where none was found. Raises BadFrames when there is none at all."""
    found: dict[str, Circle] = {}
    notes = []
    for frame in real.frames:
        try:
            found[frame.name] = contact_circle(frame.image, real.reference, ball)
        except NoCircle as error:
            notes.append(f"{frame.name}: not pressed: {error}")
    if not found:
        raise BadFrames(f"{real.name}: no frame shows a ball's contact, so there is nothing to press. {notes[0]}")
    return found, notes

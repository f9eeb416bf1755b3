"""Simulated presses that match real frames: the same ball at the same place, with the same contact radius.

So the whole simulation, mechanics and light, can be compared with real frames without other data. Depth and place are
fitted until the contact in the simulated picture has the radius and place of the real one. The comparison judges shape
and colour of a press, not its force or depth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calibration.errors import BadFrames
from calibration.frame_set import Frame, FrameSet
from calibration.light.darkness import dark_circle
from calibration.light.dent import Circle, NoCircle, find_contact_circle
from robot.studies.tuning import MAX_DEPTH_SHARE, MIN_DEPTH_MATCH, RADIUS_TOLERANCE
from tacsim.interface import Image, Pose, SurfaceMap
from tacsim.models.scene import GelSurface, Scene, Sphere
from tacsim.models.sensor import CanonicalGrid, SensorModel
from tacsim.optics.noise import noise_source
from tacsim.optics.render import Renderer
from tacsim.optics.surface import surface_map
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.world import World, make_world

# The contact circle in a picture, given the one without contact and the ball's radius [px]. Raises NoCircle, BadFrames
CircleFinder = Callable[[Image, Image, float], Circle]

# Edge of the gel's elements for such presses [m]. At 0.5 mm, with two to four elements in a contact's radius, the
# surface is too round at the rim: at 1.2 contact radii its slope is too large by up to a tenth of the rim's slope. A
# classifier detects that (docs/measurements/light-and-shadows.md).
ELEMENT = 0.25e-3
MAX_STEP = 1.3  # factor on the depth from one attempt to the next


def match_presses(
    real: FrameSet,
    scene: Scene,
    sensor: SensorModel,
    grid: CanonicalGrid,
    on_press: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[FrameSet, list[str]]:
    """Simulated frames for those of `real`, with the same names, and notes on frames that could not be simulated.

    Args:
        real: frames of a ball's presses.
        scene: with that ball as its indenter.
        sensor: renders the pictures, with the size and the noise of the sensor's calibration.
        grid: of the returned surfaces.

    A press that cannot be simulated (too deep for the gel, or the simulation diverged) has no frame.

    Raises:
        BadFrames: the scene has no ball, the pictures have another size, or no frame shows contact.
    """
    if scene.indenter is None or not isinstance(scene.indenter.geometry, Sphere):
        raise BadFrames(f"scene '{scene.name}' presses no ball; presses are placed by the contact circle of a ball")
    if real.shape != (sensor.geometry.height, sensor.geometry.width):
        raise BadFrames(
            f"{real.name} is {real.shape[1]} x {real.shape[0]} px, the calibration is of "
            f"{sensor.geometry.width} x {sensor.geometry.height}; it belongs to another sensor or setting"
        )
    ball = scene.indenter.geometry.radius
    # most lights show slopes as colour; a light without direction shows contact as darkness
    find = find_contact_circle if sensor.darkness is None else dark_circle
    circles, notes = _find_circles(real, find, ball / sensor.geometry.pixel_pitch)
    gel = _PressedGel(scene, ball, sensor, grid, find)
    done: dict[str, Frame] = {}
    not_made: set[str] = set()
    # sorted by depth, so that the gel is only loaded: it does not peel off the ball
    for name, circle in sorted(circles.items(), key=lambda item: item[1].radius):
        on_press(len(done) + len(not_made), len(circles))
        try:
            image, surface, warning = gel.press(circle)
        except (CannotPress, SimulationDiverged) as reason:  # the state of the gel is unchanged
            not_made.add(name)
            notes.append(f"{name}: not pressed: {reason}")
            continue
        done[name] = Frame(name, image, surface)
        notes += [f"{name}: {warning}"] if warning else []
    noise = noise_source(sensor, scene.name)
    frames = []
    for number, frame in enumerate(frame for frame in real.frames if frame.name not in not_made):
        made = done.get(frame.name, Frame(frame.name, *gel.untouched))
        frames.append(made if noise is None else replace(made, image=noise(made.image, number + 1)))
    reference = gel.untouched[0] if noise is None else noise(gel.untouched[0], 0)
    return FrameSet(
        f"scene {scene.name}", reference, "the untouched simulated gel", tuple(frames), simulated=True, same_pixels=True
    ), notes


class CannotPress(ValueError):
    """A contact is wider than this gel allows. The message gives the possible depth."""


class _PressedGel:
    """One gel under a ball. The press is at the centre, and the surface is then moved under the camera, so effects of
    the gel's border are not simulated."""

    def __init__(self, scene: Scene, ball: float, sensor: SensorModel, grid: CanonicalGrid, find: CircleFinder) -> None:
        self.ball, self._sensor, self._grid, self._find = ball, sensor, grid, find
        self._world: World = make_world(scene)
        self._thickness = scene.gel.size[2]
        self._deepest = MAX_DEPTH_SHARE * self._thickness
        self._last: tuple[float, float] | None = None  # contact radius [px] and depth [m] of the press before
        self._render = Renderer(sensor, scene.gel.size[:2])
        self.untouched = self._render_at(*sensor.geometry.principal)

    def press(self, circle: Circle) -> tuple[Image, SurfaceMap, str]:
        """Picture and surface of a press with this contact circle [px], and a warning if the fit failed. Raises
        CannotPress, SimulationDiverged."""
        max_attempts = 6  # presses to find the depth
        pitch, place = self._sensor.geometry.pixel_pitch, np.array([circle.x, circle.y])
        contact = circle.radius * pitch
        self._require_room(contact, self.ball - np.sqrt(max(self.ball**2 - contact**2, 0.0)))
        hertz = contact**2 / self.ball
        depth = min(hertz if self._last is None else _hertz_depth(*self._last, circle.radius), self._deepest)
        tried: list[tuple[float, float]] = []
        for _ in range(max_attempts):
            settled = self._press_to(depth)
            image, surface = self._render_at(*place)
            try:
                found = self._find(image, self.untouched[0], self.ball / pitch)
            except NoCircle as error:
                return image, surface, f"simulated picture: {error}"
            # light shifts a found circle, in the real and in the simulated picture: both must be found at one place
            place += circle.x - found.x, circle.y - found.y
            radius = found.radius
            self._last = radius, depth
            if abs(radius - circle.radius) <= RADIUS_TOLERANCE:
                return *self._render_at(*place), "" if settled else "not settled; raise settling.max_substeps"
            tried.append((radius, depth))
            wanted = _next_depth(tried, circle.radius)
            if wanted > self._deepest and depth > MIN_DEPTH_MATCH * self._deepest:
                if radius < MIN_DEPTH_MATCH * circle.radius:
                    self._require_room(contact, wanted)
                break
            depth = min(wanted, self._deepest)
        words = f"{abs(radius - circle.radius):.1f} px {'wider' if radius > circle.radius else 'narrower'}"
        return *self._render_at(*place), f"the contact is {words} than the real one"

    def _require_room(self, contact: float, depth: float) -> None:
        """Raises CannotPress if a contact radius [m] needs a `depth` [m] beyond the maximum."""
        if depth > self._deepest:
            raise CannotPress(
                f"a contact of {contact * 1e3:.2f} mm radius needs the ball {depth * 1e3:.2f} mm deep or more, and a "
                f"gel of {self._thickness * 1e3:.3g} mm can be pressed {self._deepest * 1e3:.2f} mm; give the gel's "
                "true thickness (--set gel.size=...), and check the ball's radius and the pixel pitch"
            )

    def _press_to(self, depth: float) -> bool:
        """Moves the ball to this depth [m]; True if the gel settled."""
        pose = self._world.pose("indenter")
        target = Pose(np.array([*pose.position[:2], self.ball - depth]), pose.quaternion)
        return self._world.move({"indenter": target}).settled

    def _render_at(self, x: float, y: float) -> tuple[Image, SurfaceMap]:
        """Picture and surface with the centre of the gel at x, y [px]."""
        at = place_surface(self._world.surface("lower"), x, y, self._sensor)
        return self._render(at), surface_map(at, self._grid, self._sensor.markers)


def place_surface(surface: GelSurface, x: float, y: float, sensor: SensorModel) -> GelSurface:
    """The surface, moved so that the centre of its gel is at the pixel x, y."""
    (u0, v0), pitch = sensor.geometry.principal, sensor.geometry.pixel_pitch
    x0, y0 = surface.origin
    return replace(surface, origin=(x0 + (x - u0) * pitch, y0 + (y - v0) * pitch))


def _hertz_depth(radius: float, depth: float, wanted: float) -> float:
    """The depth at which the Hertz contact radius changes from `radius` to `wanted`, within a factor of MAX_STEP."""
    return depth * float(np.clip((wanted / radius) ** 2, 1 / MAX_STEP, MAX_STEP))


def _next_depth(tried: list[tuple[float, float]], wanted: float) -> float:
    """The depth [m] for a contact radius `wanted` [px], interpolated from the two nearest of the `tried` radii and
    depths, because beyond small slopes the contact grows more slowly than by Hertz."""
    near, *others = sorted(tried, key=lambda one: abs(one[0] - wanted))
    if others and (near[0] - others[0][0]) * (near[1] - others[0][1]) > 0:
        growth = (near[1] - others[0][1]) / (near[0] ** 2 - others[0][0] ** 2)
        found = near[1] + (wanted**2 - near[0] ** 2) * growth
        return float(np.clip(found, near[1] / MAX_STEP, near[1] * MAX_STEP))
    return _hertz_depth(*near, wanted)


def _find_circles(real: FrameSet, find: CircleFinder, ball: float) -> tuple[dict[str, Circle], list[str]]:
    """Contact circles by frame name, and notes on frames without one. Raises BadFrames if no frame has one."""
    found: dict[str, Circle] = {}
    notes = []
    for frame in real.frames:
        try:
            found[frame.name] = find(frame.image, real.reference, ball)
        except NoCircle as error:
            notes.append(f"{frame.name}: not pressed: {error}")
    if not found:
        raise BadFrames(f"{real.name}: no frame shows a ball's contact, so there is nothing to press. {notes[0]}")
    return found, notes

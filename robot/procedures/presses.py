"""Records presses of a ball by hand with a running camera: the frames for the light calibration of a sensor.

The person may need both hands for the ball, so a press is taken automatically: when the picture has changed and then
stands still. The next press is requested when the gel looks untouched again.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.errors import BadFrames
from calibration.light.darkness import find_dark_press, is_direction_free
from calibration.light.dent import ContactCircle, NoCircle
from calibration.light.press import find_press, mean_reference_colour
from calibration.light.tuning import MIN_SEPARATION
from calibration.markers.dots import DotEraser, NoLattice
from calibration.markers.flow import find_markers
from robot.procedures.session import CannotCalibrate, FrameSource, Session
from tacsim.interface import Float32, Image, TactileFrame

THIRDS = ("left", "middle", "right"), ("top", "middle", "bottom")
MAX_STILL_CHANGE = 4.0  # a cell with a larger change is in motion [grey levels]
MIN_CONTACT_CHANGE = 8.0  # a cell that differs more from the reference is touched [grey levels]
PRESS_REST_TIME = 0.5  # a picture without motion for this time stands still [s]
REFERENCE = "background.png"
NOISE_FRAMES = 8  # pictures without contact, for the noise of the camera


class PressCollection:
    """The presses so far.

    Args:
        reference: (H, W, 3) uint8 RGB, the native picture without contact.
        ball: radius of the ball [px of the metric picture].
        rectify: native picture -> metric one; None: they are the same.

    Raises BadFrames for a reference that is dark or saturated.
    """

    def __init__(self, reference: Image, ball: float, rectify: Callable[[Image], Image] | None = None) -> None:
        self._rectify = rectify if rectify is not None else lambda image: image
        self._reference = self._rectify(reference)
        self._mean = mean_reference_colour(self._reference)
        self._ball = ball
        self._circles: list[ContactCircle] = []

    @property
    def circles(self) -> tuple[ContactCircle, ...]:
        """Contacts of the presses so far, in the metric picture [px]."""
        return tuple(self._circles)

    def add_image(self, image: Image) -> ContactCircle:
        """Adds a native picture and returns its contact. Raises BadFrames with the reason if it is refused."""
        seen = self._rectify(image)
        dark = is_direction_free([(seen - np.float64(self._reference)) / self._mean])
        find = find_dark_press if dark else find_press
        try:
            circle = find("press", seen, self._reference, self._mean, self._ball).circle
        except NoCircle as none:
            raise BadFrames(str(none)) from none
        height, width = self._reference.shape[:2]
        if min(circle.x, circle.y, width - 1 - circle.x, height - 1 - circle.y) < circle.radius:
            raise BadFrames("the contact is cut off by the border of the picture; press nearer to the middle")
        for number, other in enumerate(self._circles, start=1):
            if math.hypot(circle.x - other.x, circle.y - other.y) < MIN_SEPARATION * max(circle.radius, other.radius):
                raise BadFrames(f"it is in the same place as press {number}; press elsewhere")
        self._circles.append(circle)
        return circle

    def next_place(self) -> str:
        """The next place to press: the one of nine parts of the picture that is farthest from all presses so far."""
        height, width = self._reference.shape[:2]
        best, place = -1.0, "middle"
        for row in (1, 0, 2):  # the middle first
            for column in (1, 0, 2):
                x, y = (column + 0.5) * width / 3, (row + 0.5) * height / 3
                away = min((math.hypot(c.x - x, c.y - y) for c in self._circles), default=0.0)
                if away > best:
                    across, down = THIRDS[0][column], THIRDS[1][row]
                    best, place = away, across if across == down else f"{down} {across}"
        return place


@dataclass(frozen=True, slots=True)
class BallPressPlan:
    ball: float  # radius [px of the metric picture]
    presses: int = 8
    timeout: float = 180.0  # for each step of the person [s]
    rectify: Callable[[Image], Image] | None = None  # native picture -> metric picture; None: they are equal
    markers: bool = False  # dots are printed on the gel


def record_presses(camera: FrameSource, plan: BallPressPlan, session: Session[tuple[str, Image]]) -> tuple[Image, ...]:
    """Guides a person through the pictures without contact and the presses of `plan`; records name and native picture
    of each press. The pictures without contact are stored first and returned; the last is the reference.

    Raises CannotCalibrate if nothing happens within the timeout or the gel does not return to the reference; BadFrames
    if a picture without contact is dark or saturated; and the errors of the camera.
    """
    untouched: tuple[Image, ...] = ()
    monitor = _ContactMonitor(camera, plan.timeout, session)
    with session.until_stopped():
        session.report("Take everything off the gel.")
        untouched = monitor.wait_for_rest()
        reference = untouched[-1]
        collection = PressCollection(reference, plan.ball, _marker_eraser(plan, reference))
        session.store((REFERENCE, reference))
        for number, image in enumerate(untouched[:-1], start=1):
            session.store((f"{Path(REFERENCE).stem}_{number}.png", image))
        monitor.set_reference(reference)
        while len(session.measurements) < plan.presses:
            session.progress(len(session.measurements))
            number = len(session.measurements) + 1
            session.report(
                f"Press {number} of {plan.presses}: press the ball into the gel, at the {collection.next_place()} of "
                "the picture, and hold it still."
            )
            image = monitor.wait_for_press()
            try:
                circle = collection.add_image(image)
            except BadFrames as reason:
                session.left_out.append(str(reason))
                session.report(f"Not taken: {reason}.")
            else:
                session.add_measurement((f"press_{number:02d}.png", image))
                session.report(f"Taken: contact at {circle.x:.0f}, {circle.y:.0f} px, radius {circle.radius:.0f} px.")
            session.report("Lift the ball off the gel.")
            monitor.wait_for_lift()
        session.progress(len(session.measurements))
    return untouched


def _marker_eraser(plan: BallPressPlan, reference: Image) -> Callable[[Image], Image] | None:
    """Function from a native picture to the metric picture without dots. Raises BadFrames."""
    if not plan.markers:
        return plan.rectify
    rectify = plan.rectify if plan.rectify is not None else lambda image: image
    try:
        _, radius = find_markers(rectify(reference))
    except NoLattice as nothing:
        raise BadFrames(f"{nothing}; omit --markers if no dots are printed") from None
    erase = DotEraser(radius)
    return lambda image: erase(rectify(image))


class _ContactMonitor:
    """Waits for actions of a person, seen in the pictures. All waits raise Stopped, CannotCalibrate."""

    def __init__(self, camera: FrameSource, timeout: float, session: Session[tuple[str, Image]]) -> None:
        self._frames, self._timeout, self._say = session.frames(camera), timeout, session.report
        self._anchor: Float32 | None = None  # first picture since the last motion
        self._still_since = 0.0
        self._reference: Float32 | None = None

    def set_reference(self, image: Image) -> None:
        """Sets the reference: contact is a difference from `image`."""
        self._reference = _cell_means(image)

    def wait_for_rest(self) -> tuple[Image, ...]:
        """The last pictures, at most NOISE_FRAMES, of `rest_time` without motion."""
        rest_time = 1.5  # the same for the reference without contact [s]
        begin = None
        shown: deque[Image] = deque(maxlen=NOISE_FRAMES)
        while True:
            frame, still_time, _ = self._next_frame()
            begin = frame.time if begin is None else begin
            if still_time == 0.0:
                shown.clear()
            shown.append(frame.image)
            if still_time >= rest_time:
                return tuple(shown)
            self._check_timeout(
                frame.time - begin, "the picture does not come to rest; is something moving in front of the gel?"
            )

    def wait_for_press(self) -> Image:
        """A picture of a contact without motion for PRESS_REST_TIME. Reminds the person while it moves."""
        reminder_time = 5.0  # after this time without rest the person is reminded [s]
        begin = moving = None
        while True:
            frame, still_time, is_touched = self._next_frame()
            begin = frame.time if begin is None else begin
            if is_touched and still_time >= PRESS_REST_TIME:
                return frame.image
            if not is_touched:
                moving = None
                self._check_timeout(frame.time - begin, "nothing touched the gel (or too lightly to be seen)")
                continue
            moving = frame.time if moving is None else moving
            if frame.time - moving > reminder_time:
                self._say("Still moving: hold the ball still.")
                moving = frame.time
            self._check_timeout(frame.time - begin, "the press did not come to rest")

    def wait_for_lift(self) -> None:
        """Waits until the gel looks as it did without contact."""
        begin = None
        while True:
            frame, still_time, is_touched = self._next_frame()
            begin = frame.time if begin is None else begin
            if not is_touched and still_time >= PRESS_REST_TIME:
                return
            self._check_timeout(
                frame.time - begin,
                "the gel does not look as it did before the presses. If nothing touches it, the light has changed, or "
                "something was on it in the picture without contact: start again",
            )

    def _next_frame(self) -> tuple[TactileFrame, float, bool]:
        """The next new frame, the time without motion [s], and whether the gel is touched."""
        frame = next(self._frames)
        cells = _cell_means(frame.image)
        # compared with the first still picture, not the last: a slow creep is motion too
        if self._anchor is None or float(np.abs(cells - self._anchor).max()) > MAX_STILL_CHANGE:
            self._anchor, self._still_since = cells, frame.time
        is_touched = False
        if self._reference is not None:
            change = cells - self._reference
            change -= np.median(change, axis=(0, 1))  # so the drift of a lamp is not a contact
            is_touched = float(np.abs(change).max()) > MIN_CONTACT_CHANGE
        return frame, frame.time - self._still_since, is_touched

    def _check_timeout(self, waited: float, reason: str) -> None:
        if waited > self._timeout:
            raise CannotCalibrate(f"no result within {self._timeout:g} s: {reason}")


def _cell_means(image: Image) -> Float32:
    """Means over CELL x CELL pixels, (h, w, 3)."""
    # side in pixels of the cells over which colour is averaged: removes noise and JPEG errors, keeps contacts
    cell_side = 8
    import cv2

    size = (max(1, image.shape[1] // cell_side), max(1, image.shape[0] // cell_side))
    return np.asarray(cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA), dtype=np.float32)

"""Presses of a ball by hand before a running camera: the frames from which a sensor's light is calibrated.

Both hands may be at the ball: a press is taken by itself once the picture has changed and then stands still, and the
next one is asked for once the gel looks untouched again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.errors import BadFrames
from calibration.light.press_collection import PressCollection
from calibration.markers.dots import DotEraser
from calibration.markers.flow import find_markers
from calibration.markers.lattice import NoLattice
from robot.procedures.session import CannotCalibrate, FrameSource, Session
from robot.procedures.tuning import HOLD_TIME, MIN_CONTACT_CHANGE, MIN_MOTION
from tacsim.interface import Float32, Image, TactileFrame

REFERENCE = "background.png"
NOISE_FRAMES = 8  # pictures without contact that tell the camera's noise


@dataclass(frozen=True, slots=True)
class BallPressPlan:
    ball: float  # radius [px of the metric picture]
    presses: int = 8
    patience: float = 180.0  # for each step of the person's [s]
    rectify: Callable[[Image], Image] | None = None  # native picture -> metric one; None: they are the same
    markers: bool = False  # dots are printed on the gel


def record_presses(camera: FrameSource, plan: BallPressPlan, session: Session[tuple[str, Image]]) -> tuple[Image, ...]:
    """Leads a person through the pictures without contact and the presses of `plan`; takes name and native picture of
    each press. The pictures without contact are kept first, and returned; the last is the reference.

    Raises CannotCalibrate when nothing happens for long or the gel does not become again what it was; BadFrames for a
    picture without contact that is dark or saturated; what the camera raises.
    """
    untouched: tuple[Image, ...] = ()
    monitor = _ContactMonitor(camera, plan.patience, session)
    with session.until_stopped():
        session.say("Take everything off the gel.")
        untouched = monitor.wait_for_rest()
        reference = untouched[-1]
        collection = PressCollection(reference, plan.ball, _marker_eraser(plan, reference))
        session.keep((REFERENCE, reference))
        for number, image in enumerate(untouched[:-1], start=1):
            session.keep((f"{Path(REFERENCE).stem}_{number}.png", image))
        monitor.set_reference(reference)
        while len(session.taken) < plan.presses:
            session.progress(len(session.taken))
            number = len(session.taken) + 1
            session.say(
                f"Press {number} of {plan.presses}: press the ball into the gel, at the {collection.next_place()} of "
                "the picture, and hold it still."
            )
            image = monitor.wait_for_press()
            try:
                circle = collection.add_image(image)
            except BadFrames as why:
                session.left_out.append(str(why))
                session.say(f"Not taken: {why}.")
            else:
                session.take((f"press_{number:02d}.png", image))
                session.say(f"Taken: contact at {circle.x:.0f}, {circle.y:.0f} px, radius {circle.radius:.0f} px.")
            session.say("Lift the ball off the gel.")
            monitor.wait_for_lift()
        session.progress(len(session.taken))
    return untouched


def _marker_eraser(plan: BallPressPlan, reference: Image) -> Callable[[Image], Image] | None:
    """Native picture -> the metric one that presses are judged by, without dots. Raises BadFrames."""
    if not plan.markers:
        return plan.rectify
    rectify = plan.rectify if plan.rectify is not None else lambda image: image
    try:
        _, radius = find_markers(rectify(reference))
    except NoLattice as nothing:
        raise BadFrames(f"{nothing}; leave --markers out if none are printed") from None
    erase = DotEraser(radius)
    return lambda image: erase(rectify(image))


class _ContactMonitor:
    """Waits for what a person does, by the pictures alone. Whatever waits raises Stopped, CannotCalibrate."""

    def __init__(self, camera: FrameSource, patience: float, session: Session[tuple[str, Image]]) -> None:
        self._frames, self._patience, self._say = session.frames(camera), patience, session.say
        self._anchor: Float32 | None = None  # the picture that nothing has moved since
        self._since = 0.0
        self._reference: Float32 | None = None

    def set_reference(self, image: Image) -> None:
        """Contact is told by the difference from `image`."""
        self._reference = _cell_means(image)

    def wait_for_rest(self) -> tuple[Image, ...]:
        """The last pictures, NOISE_FRAMES at most, of a time of REST in which none has moved."""
        rest_time = 1.5  # the same for the one without contact, which everything is measured against [s]
        begun = None
        shown: deque[Image] = deque(maxlen=NOISE_FRAMES)
        while True:
            frame, still, _ = self._next()
            begun = frame.time if begun is None else begun
            if still == 0.0:
                shown.clear()
            shown.append(frame.image)
            if still >= rest_time:
                return tuple(shown)
            self._give_up(frame.time - begun, "the picture does not come to rest; is something moving before the gel?")

    def wait_for_press(self) -> Image:
        """A picture of a contact that has not moved for HOLD_TIME; the person is told now and then while it moves."""
        reminder_time = 5.0  # a press that does not come to rest for so long is worth a word [s]
        begun = moving = None
        while True:
            frame, still, touched = self._next()
            begun = frame.time if begun is None else begun
            if touched and still >= HOLD_TIME:
                return frame.image
            if not touched:
                moving = None
                self._give_up(frame.time - begun, "nothing touched the gel (or too lightly to be seen)")
                continue
            moving = frame.time if moving is None else moving
            if frame.time - moving > reminder_time:
                self._say("Still moving: hold the ball still.")
                moving = frame.time
            self._give_up(frame.time - begun, "the press did not come to rest")

    def wait_for_lift(self) -> None:
        """Until the gel is as it was without contact."""
        begun = None
        while True:
            frame, still, touched = self._next()
            begun = frame.time if begun is None else begun
            if not touched and still >= HOLD_TIME:
                return
            self._give_up(
                frame.time - begun,
                "the gel does not look as it did before the presses. If nothing touches it, the light has changed, or "
                "something lay on it when the picture without contact was taken: begin again",
            )

    def _next(self) -> tuple[TactileFrame, float, bool]:
        """The next new frame, how long nothing has moved in it [s], and whether the gel is touched."""
        frame = next(self._frames)
        cells = _cell_means(frame.image)
        # against the first of the still ones, not the last: a slow creep is motion too
        if self._anchor is None or float(np.abs(cells - self._anchor).max()) > MIN_MOTION:
            self._anchor, self._since = cells, frame.time
        touched = False
        if self._reference is not None:
            change = cells - self._reference
            change -= np.median(change, axis=(0, 1))  # a lamp that warms up touches nothing
            touched = float(np.abs(change).max()) > MIN_CONTACT_CHANGE
        return frame, frame.time - self._since, touched

    def _give_up(self, waited: float, why: str) -> None:
        if waited > self._patience:
            raise CannotCalibrate(f"given up after {self._patience:g} s: {why}")


def _cell_means(image: Image) -> Float32:
    """Means over CELL x CELL pixels, (h, w, 3)."""
    cell_side = 8  # colour is averaged over so many pixels each way: noise and JPEG go, contacts stay
    import cv2

    size = (max(1, image.shape[1] // cell_side), max(1, image.shape[0] // cell_side))
    return np.asarray(cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA), dtype=np.float32)

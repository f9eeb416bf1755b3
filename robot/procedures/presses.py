"""Presses of a ball by hand before a running camera: the frames from which a sensor's light is calibrated.

Both hands may be at the ball: a press is taken by itself once the picture has changed and then stands still, and the
next one is asked for once the gel looks untouched again.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calibration.errors import BadFrames, CalibrationError
from calibration.light.press_collection import PressCollection
from calibration.markers.dots import DotEraser
from calibration.markers.flow import find_markers
from calibration.markers.lattice import NoLattice
from tacsim.interface import EndOfEpisode, TactileFrame
from tacsim.models.hardware import CameraSensorConfig
from tacsim.models.rig import RigConfig

Image = NDArray[np.uint8]
Float32 = NDArray[np.float32]

LOOK = 5e-3  # between two looks at the camera [s]
PICTURE = 10.0  # longest wait for one [s]
CELL = 8  # colour is averaged over so many pixels each way: noise and JPEG go, contacts stay
MOTION = 4.0  # a cell that changes by more is in motion [grey levels]
TOUCH = 8.0  # a cell that differs from the reference by more than the usual is touched [grey levels]
HOLD = 0.5  # a picture that has not moved for so long stands still [s]
REST = 1.5  # the same for the one without contact, which everything is measured against [s]
RESTLESS = 5.0  # a press that does not come to rest for so long is worth a word [s]
REFERENCE = "background.png"
NOISE_FRAMES = 8  # pictures without contact that tell the camera's noise


class CannotPress(CalibrationError):
    """This sensor is not such that a person could press a ball before it, or nobody did."""


class Seeing(Protocol):
    """What is needed of a camera."""

    def read(self, timeout: float) -> TactileFrame: ...


@dataclass(frozen=True, slots=True)
class PressPlan:
    """What to take."""

    ball: float  # radius [px of the metric picture]
    presses: int = 8
    patience: float = 180.0  # for each step of the person's [s]
    rectify: Callable[[Image], Image] | None = None  # native picture -> metric one; None: they are the same
    markers: bool = False  # dots are printed on the gel


@dataclass(slots=True)
class PressRecord:
    """What came of a plan."""

    reference: Image | None = None
    untouched: tuple[Image, ...] = ()  # pictures without contact, native; the reference is the last
    presses: list[tuple[str, Image]] = field(default_factory=list)  # names and native pictures
    refused: list[str] = field(default_factory=list)  # why, in order


def camera_facts(config: RigConfig, sensor: str) -> CameraSensorConfig:
    """Of a sensor before whose camera a person can press. Raises CannotPress."""
    eye = config.sensors.get(sensor)
    if not isinstance(eye, CameraSensorConfig):
        known = (
            ", ".join(name for name, each in config.sensors.items() if isinstance(each, CameraSensorConfig)) or "none"
        )
        raise CannotPress(f"rig '{config.name}': '{sensor}' is no sensor with a camera; cameras: {known}")
    if eye.mock is not None:
        raise CannotPress(
            f"rig '{config.name}': sensors.{sensor} has a mock camera that a simulation feeds; nobody can press its "
            "gel, and its model is known"
        )
    return eye


def record_presses(
    camera: Seeing,
    plan: PressPlan,
    keep: Callable[[str, Image], None],
    say: Callable[[str], None],
    tell: Callable[[int], None] = lambda done: None,
    stop: Callable[[], bool] = lambda: False,
) -> PressRecord:
    """Leads a person through the pictures without contact and the presses of `plan`.

    keep: is given name and native picture of each as soon as it is taken, those without contact first.
    say: is told what to do next, and what became of it, a sentence at a time.
    tell: how many presses are done.

    A stop, and the end of a recorded source, leave what was taken. Raises CannotPress when nothing happens for long
    or the gel does not become again what it was; BadFrames for a picture without contact that is dark or saturated;
    what the camera raises.
    """
    record = PressRecord()
    watch = _Watch(camera, plan.patience, stop)
    try:
        say("Take everything off the gel.")
        record.untouched = watch.rest()
        record.reference = record.untouched[-1]
        collection = PressCollection(record.reference, plan.ball, _to_judge(plan, record.reference))
        keep(REFERENCE, record.reference)
        for number, image in enumerate(record.untouched[:-1], start=1):
            keep(f"{Path(REFERENCE).stem}_{number}.png", image)
        watch.untouched(record.reference)
        while len(record.presses) < plan.presses:
            tell(len(record.presses))
            number = len(record.presses) + 1
            say(
                f"Press {number} of {plan.presses}: press the ball into the gel, at the {collection.next_place()} of "
                "the picture, and hold it still."
            )
            image = watch.press(lambda: say("Still moving: hold the ball still."))
            try:
                circle = collection.offer(image)
            except BadFrames as why:
                record.refused.append(str(why))
                say(f"Not taken: {why}.")
            else:
                name = f"press_{number:02d}.png"
                record.presses.append((name, image))
                keep(name, image)
                say(f"Taken: contact at {circle.x:.0f}, {circle.y:.0f} px, radius {circle.radius:.0f} px.")
            say("Lift the ball off the gel.")
            watch.lift()
        tell(len(record.presses))
    except (_Stopped, EndOfEpisode):
        pass
    return record


def _to_judge(plan: PressPlan, reference: Image) -> Callable[[Image], Image] | None:
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


class _Stopped(Exception):
    """Somebody asked for the end."""


class _Watch:
    """Waits for what a person does, by the pictures alone. Whatever waits raises _Stopped, CannotPress."""

    def __init__(self, camera: Seeing, patience: float, stop: Callable[[], bool]) -> None:
        self._camera, self._patience, self._stop = camera, patience, stop
        self._index = -1
        self._anchor: Float32 | None = None  # the picture that nothing has moved since
        self._since = 0.0
        self._cells: Float32 | None = None  # of the reference

    def untouched(self, image: Image) -> None:
        """What is touched is told by the difference from `image`."""
        self._cells = _cells(image)

    def rest(self) -> tuple[Image, ...]:
        """The last pictures, NOISE_FRAMES at most, of a time of REST in which none has moved."""
        begun = None
        shown: deque[Image] = deque(maxlen=NOISE_FRAMES)
        while True:
            frame, still, _ = self._next()
            begun = frame.time if begun is None else begun
            if still == 0.0:
                shown.clear()
            shown.append(frame.image)
            if still >= REST:
                return tuple(shown)
            self._give_up(frame.time - begun, "the picture does not come to rest; is something moving before the gel?")

    def press(self, restless: Callable[[], None]) -> Image:
        """A picture of a touch that has not moved for HOLD; `restless` is called now and then while it moves."""
        begun = moving = None
        while True:
            frame, still, touched = self._next()
            begun = frame.time if begun is None else begun
            if touched and still >= HOLD:
                return frame.image
            if not touched:
                moving = None
                self._give_up(frame.time - begun, "nothing touched the gel (or too lightly to be seen)")
                continue
            moving = frame.time if moving is None else moving
            if frame.time - moving > RESTLESS:
                restless()
                moving = frame.time
            self._give_up(frame.time - begun, "the press did not come to rest")

    def lift(self) -> None:
        """Until the gel is as it was without contact."""
        begun = None
        while True:
            frame, still, touched = self._next()
            begun = frame.time if begun is None else begun
            if not touched and still >= HOLD:
                return
            self._give_up(
                frame.time - begun,
                "the gel does not look as it did before the presses. If nothing touches it, the light has changed, or "
                "something lay on it when the picture without contact was taken: begin again",
            )

    def _next(self) -> tuple[TactileFrame, float, bool]:
        """The next new frame, how long nothing has moved in it [s], and whether the gel is touched."""
        while True:
            if self._stop():
                raise _Stopped
            frame = self._camera.read(PICTURE)
            if frame.index != self._index:
                break
            time.sleep(LOOK)
        self._index = frame.index
        cells = _cells(frame.image)
        # against the first of the still ones, not the last: a slow creep is motion too
        if self._anchor is None or float(np.abs(cells - self._anchor).max()) > MOTION:
            self._anchor, self._since = cells, frame.time
        touched = False
        if self._cells is not None:
            change = cells - self._cells
            change -= np.median(change, axis=(0, 1))  # a lamp that warms up touches nothing
            touched = float(np.abs(change).max()) > TOUCH
        return frame, frame.time - self._since, touched

    def _give_up(self, waited: float, why: str) -> None:
        if waited > self._patience:
            raise CannotPress(f"given up after {self._patience:g} s: {why}")


def _cells(image: Image) -> Float32:
    """Means over CELL x CELL pixels, (h, w, 3)."""
    import cv2

    size = (max(1, image.shape[1] // CELL), max(1, image.shape[0] // CELL))
    return np.asarray(cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA), dtype=np.float32)

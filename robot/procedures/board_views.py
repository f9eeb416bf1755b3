"""Pictures of a board by hand before a running camera: those from which a lens is calibrated, or the view of a gel.

Both hands are at the board: a view is taken by itself once the whole board is found, stands still, and is seen
otherwise than in all views before. What is not taken is said with the reason, and skipped.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.lens.board import BadBoard, Board, Points, find_board
from robot.procedures.presses import LOOK, PICTURE, Seeing
from tacsim.interface import EndOfEpisode, FloatArray

Image = NDArray[np.uint8]

STILL = 0.003  # of the picture's longer side: a board whose points move less stands still
HOLD = 0.4  # for so long [s]
APART = 0.04  # of the same: two views are the same if their points differ by less, root mean square
REMIND = 4.0  # between two words on why nothing is taken [s]
WAYS = (
    "facing the camera, so that it fills the picture",
    "its left side nearer to the camera, by 30 degrees",
    "its right side nearer to the camera, by 30 degrees",
    "its upper side nearer to the camera, by 30 degrees",
    "its lower side nearer to the camera, by 30 degrees",
    "tilted, towards the upper left corner of the picture",
    "tilted, towards the lower right corner of the picture",
    "tilted, towards the upper right corner of the picture",
    "tilted, towards the lower left corner of the picture",
)
ON_GEL = "lay the board on the gel, print side down, and leave it there"


class CannotView(CalibrationError):
    """Nobody held a board before the camera."""


@dataclass(frozen=True, slots=True)
class ViewPlan:
    """What to take."""

    board: Board
    views: int = 12
    on_gel: bool = False  # the board lies on the gel: one view
    reference: Image | None = None  # native picture without the board, where contrast is low
    patience: float = 180.0  # for each view [s]


@dataclass(slots=True)
class ViewRecord:
    """What came of a plan."""

    views: list[tuple[str, Image]] = field(default_factory=list)  # names and native pictures
    skipped: list[str] = field(default_factory=list)  # why, in order


def record_views(
    camera: Seeing,
    plan: ViewPlan,
    keep: Callable[[str, Image], None],
    say: Callable[[str], None],
    tell: Callable[[int], None] = lambda done: None,
    stop: Callable[[], bool] = lambda: False,
) -> ViewRecord:
    """Leads a person through the views of `plan`.

    keep: is given name and native picture of each as soon as it is taken.
    say: is told what to do next, and what became of it, a sentence at a time.
    tell: how many views are done.

    A stop, and the end of a recorded source, leave what was taken. Raises CannotView when no view comes for long, and
    what the camera raises.
    """
    record, taken = ViewRecord(), list[Points]()
    look = _Look(camera, plan, stop)
    try:
        while len(taken) < plan.views:
            number = len(taken) + 1
            tell(len(taken))
            way = ON_GEL if plan.on_gel else f"hold the board still, {WAYS[len(taken) % len(WAYS)]}"
            say(f"View {number} of {plan.views}: {way}.")

            def skipped(why: str) -> None:
                record.skipped.append(why)
                say(f"Skipped: {why}.")

            image, points = look.view(taken, skipped)
            name = f"view_{number:02d}.png"
            taken.append(points)
            record.views.append((name, image))
            keep(name, image)
            say(f"Taken: {len(points.image)} points, {points.spacing:.0f} px apart.")
        tell(len(taken))
    except (_Stopped, EndOfEpisode):
        pass
    return record


class _Stopped(Exception):
    """Somebody asked for the end."""


class _Look:
    """Looks for the board in picture after picture."""

    def __init__(self, camera: Seeing, plan: ViewPlan, stop: Callable[[], bool]) -> None:
        self._camera, self._plan, self._stop = camera, plan, stop
        self._index = -1

    def view(self, taken: list[Points], skipped: Callable[[str], None]) -> tuple[Image, Points]:
        """A picture of a board that stands still, seen otherwise than those taken; `skipped` is told now and then why
        there is none. Raises _Stopped, CannotView."""
        begun: float | None = None
        anchor: Points | None = None  # the board has not moved since
        since = reminded = 0.0
        why = "nothing was looked at"
        while True:
            image, now = self._next()
            if begun is None:
                begun = reminded = now
            try:
                points = find_board(image, self._plan.board, self._plan.reference)
            except BadBoard as missing:
                why, anchor = str(missing), None
            else:
                side = max(image.shape[:2])
                if anchor is None or _moved(anchor, points) > STILL * side:
                    anchor, since = points, now
                like = next((k for k, other in enumerate(taken, 1) if _moved(other, points) < APART * side), None)
                why = (
                    f"the board is seen as in view {like}; tilt it, or hold it elsewhere"
                    if like
                    else "the board moves; hold it still"
                )
                if like is None and now - since >= HOLD:
                    return image, points
            if now - reminded >= REMIND:
                skipped(why)
                reminded = now
            if now - begun > self._plan.patience:
                raise CannotView(f"given up after {self._plan.patience:g} s without a view; the last: {why}")

    def _next(self) -> tuple[Image, float]:
        """The next new picture, and when it was taken [s]."""
        while True:
            if self._stop():
                raise _Stopped
            frame = self._camera.read(PICTURE)
            if frame.index != self._index:
                self._index = frame.index
                return frame.image, frame.time
            time.sleep(LOOK)


def _moved(one: Points, other: Points) -> float:
    """How far the points that both have lie apart in the picture, root mean square [px]; infinite without any."""
    places = {tuple(place): at for place, at in zip(np.round(one.board, 9).tolist(), one.image, strict=True)}
    pairs = [
        (places[tuple(place)], at)
        for place, at in zip(np.round(other.board, 9).tolist(), other.image, strict=True)
        if tuple(place) in places
    ]
    if not pairs:
        return float("inf")
    apart: FloatArray = np.array([first - second for first, second in pairs])
    return float(np.sqrt((apart**2).sum(axis=1).mean()))

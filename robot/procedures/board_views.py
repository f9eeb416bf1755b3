"""Pictures of a board by hand before a running camera: those from which a lens is calibrated, or the view of a gel.

Both hands are at the board: a view is taken by itself once the whole board is found, stands still, and is seen
otherwise than in all views before. What is not taken is said with the reason, and skipped.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from calibration.lens.board import BadBoard, Board, Points, find_board
from robot.procedures.session import CannotCalibrate, FrameSource, Session
from tacsim.interface import FloatArray, Image, TactileFrame

STILL = 0.003  # of the picture's longer side: a board whose points move less stands still
HOLD = 0.4  # for so long [s]
DISTINCT = 0.04  # of the same: two views are the same if their points differ by less, root mean square
REMIND = 4.0  # between two words on why nothing is taken [s]
PROMPTS = (
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


@dataclass(frozen=True, slots=True)
class BoardViewPlan:
    board: Board
    views: int = 12
    on_gel: bool = False  # the board lies on the gel: one view
    reference: Image | None = None  # native picture without the board, where contrast is low
    patience: float = 180.0  # for each view [s]


def record_board_views(camera: FrameSource, plan: BoardViewPlan, session: Session[tuple[str, Image]]) -> None:
    """Leads a person through the views of `plan`, and takes name and native picture of each.

    Raises CannotCalibrate when no view comes for long, and what the camera raises.
    """
    earlier: list[Points] = []
    frames = session.frames(camera)
    with session.until_stopped():
        while len(earlier) < plan.views:
            number = len(earlier) + 1
            session.progress(len(earlier))
            prompt = ON_GEL if plan.on_gel else f"hold the board still, {PROMPTS[len(earlier) % len(PROMPTS)]}"
            session.say(f"View {number} of {plan.views}: {prompt}.")
            image, points = _next_view(frames, plan, earlier, session)
            earlier.append(points)
            session.take((f"view_{number:02d}.png", image))
            session.say(f"Taken: {len(points.image)} points, {points.spacing:.0f} px apart.")
        session.progress(len(earlier))


def _next_view(
    frames: Iterator[TactileFrame], plan: BoardViewPlan, earlier: list[Points], session: Session[tuple[str, Image]]
) -> tuple[Image, Points]:
    """A picture of a board that stands still, seen otherwise than in the earlier views; the person is told now and then
    why there is none. Raises Stopped, CannotCalibrate."""
    frame = next(frames)
    begun = reminded = since = frame.time
    anchor: Points | None = None  # where the board has stood since
    while True:
        try:
            points = find_board(frame.image, plan.board, plan.reference)
        except BadBoard as missing:
            why, anchor = str(missing), None
        else:
            side = max(frame.image.shape[:2])
            if anchor is None or _point_distance(anchor, points) > STILL * side:
                anchor, since = points, frame.time
            alike = (k for k, other in enumerate(earlier, 1) if _point_distance(other, points) < DISTINCT * side)
            same = next(alike, None)
            if same is None and frame.time - since >= HOLD:
                return frame.image, points
            why = "the board moves; hold it still"
            if same is not None:
                why = f"the board is seen as in view {same}; tilt it, or hold it elsewhere"
        if frame.time - reminded >= REMIND:
            session.left_out.append(why)
            session.say(f"Skipped: {why}.")
            reminded = frame.time
        if frame.time - begun > plan.patience:
            raise CannotCalibrate(f"given up after {plan.patience:g} s without a view; the last: {why}")
        frame = next(frames)


def _point_distance(one: Points, other: Points) -> float:
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

"""Presses of a ball, each checked at once, so that the operator can repeat it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from calibration.errors import BadFrames
from calibration.light.circle import NoCircle
from calibration.light.darkness import find_dark_press, is_direction_free
from calibration.light.dent import ContactCircle
from calibration.light.press import find_press, mean_reference_colour
from calibration.light.tuning import MIN_SEPARATION
from tacsim.interface import Image

THIRDS = ("left", "middle", "right"), ("top", "middle", "bottom")


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

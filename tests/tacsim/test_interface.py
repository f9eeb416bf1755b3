"""Fields that are made when they are first looked at."""

from __future__ import annotations

import copy
import dataclasses
import pickle
from functools import partial

import numpy as np
import pytest

from tacsim.interface import TactileFrame

made: list[int] = []


def picture(value: int) -> np.ndarray:
    made.append(value)
    return np.full((2, 3, 3), value, np.uint8)


def test_a_picture_is_made_when_it_is_looked_at_and_once() -> None:
    made.clear()
    frame = TactileFrame(partial(picture, 7), time=0.5, index=3)
    assert made == []
    assert frame.image is frame.image and (frame.image == 7).all()
    assert made == [7]
    given = np.zeros((2, 3, 3), np.uint8)
    assert TactileFrame(given, time=0.0, index=0).image is given


def test_it_is_made_before_it_is_sent_or_copied() -> None:
    for send in (lambda frame: pickle.loads(pickle.dumps(frame)), copy.deepcopy, dataclasses.replace):  # noqa: S301
        made.clear()
        frame = TactileFrame(lambda: picture(5), time=0.5, index=3)
        arrived = send(frame)
        assert (arrived.image == 5).all() and (arrived.time, arrived.index) == (0.5, 3)
        assert made == [5]


def test_a_picture_that_cannot_be_made_is_tried_again() -> None:
    frame = TactileFrame(lambda: picture(1 // 0), time=0.0, index=0)
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            _ = frame.image


def test_a_frame_needs_a_picture_and_does_not_change() -> None:
    with pytest.raises(TypeError, match="image"):
        TactileFrame(time=0.0, index=0)  # type: ignore[call-arg]
    frame = TactileFrame(picture(1), time=0.0, index=0)
    with pytest.raises(dataclasses.FrozenInstanceError):
        frame.image = picture(2)  # type: ignore[misc]

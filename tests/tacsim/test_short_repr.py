"""`repr` of dataclasses with arrays: shape, type and range of each array, one line a field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.frame_set import Frame, FrameSet
from tacsim.interface import Action, ArmState, Observation, Pose, SurfaceMap, TactileFrame, TactileObservation, Truth


def observed() -> TactileObservation:
    height = np.zeros((64, 64), np.float32)
    height[0, 0], height[1, 1] = 5e-4, -1e-5
    contact = np.zeros((64, 64), np.bool_)
    contact[:16] = True
    return TactileObservation(
        image=np.full((128, 128, 3), 128, np.uint8), gradient=None, height=height, contact=contact,
        valid=np.ones((64, 64), np.bool_), flow=np.full((0, 0, 2), 0, np.float32), time=0.1, age=0.02,
    )  # fmt: skip


ARM = ArmState(Pose(np.array([0, 0, 1 / 3])), np.zeros(6), np.array([0, 0, -1.25, 0, 0, 0]), None, 0.1)


def test_an_observation_is_a_line_a_field() -> None:
    lines = repr(Observation({"upper": observed()}, {"upper": ARM}, 0.1)).splitlines()
    assert lines[0] == "Observation("
    stripped = [line.strip() for line in lines]
    for line in (
        "image=uint8 (128, 128, 3) 128 to 128,",
        "gradient=None,",
        "height=float32 (64, 64) -1e-05 to 0.0005,",
        "contact=bool (64, 64) 25 % true,",
        "flow=float32 (0, 0, 2),",
        "wrench=[0, 0, -1.25, 0, 0, 0],",
        "pose=Pose(position=[0, 0, 0.3333], quaternion=[0, 0, 0, 1]),",
        "age=0.02,",
    ):
        assert line in stripped, lines
    assert len(lines) < 30 and max(map(len, lines)) <= 100


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (Pose(), "Pose(position=[0, 0, 0], quaternion=[0, 0, 0, 1])"),
        (Action({"upper": None}), "Action(tool={'upper': None}, grippers={})"),
        (Action(), "Action(tool={}, grippers={})"),
        (
            SurfaceMap(np.array([[np.nan, 1.0] * 4], np.float32), np.zeros((2, 2, 2), np.float32), None),
            "SurfaceMap(\n    height=float32 (1, 8) 1 to 1, 4 not finite,\n    gradient=float32 (2, 2, 2) 0 to 0,\n"
            "    flow=None,\n)",
        ),
    ],
)
def test_small_things_take_one_line(value: object, text: str) -> None:
    assert repr(value) == text


def test_a_picture_is_not_rendered_to_be_described() -> None:
    frame = TactileFrame(lambda: pytest.fail("rendered"), time=0.0, index=3)  # type: ignore[arg-type]
    assert "image=not made yet" in repr(frame)
    assert "image=uint8 (4, 5, 3) 0 to 0" in repr(TactileFrame(np.zeros((4, 5, 3), np.uint8), time=0.0, index=3))


def test_many_entries_are_counted() -> None:
    frames = tuple(Frame(f"press_{k}", np.zeros((60, 80, 3), np.uint8)) for k in range(20))
    text = repr(FrameSet("mine", frames[0].image, "background.png", frames))
    assert "frames=tuple of 20," in text and "reference=uint8 (60, 80, 3) 0 to 0," in text


TRUTH = Truth(0.01, np.zeros(3), np.zeros((5000, 3), np.float32), {"upper": Pose()})


@pytest.mark.parametrize(
    "value", [observed(), ARM, replace(ARM, joints=np.zeros(6)), TRUTH], ids=lambda each: type(each).__name__
)
def test_all_are_short(value: object) -> None:
    assert len(repr(value)) < 700

"""A ROS 2 bag behind a rig, and as one side of a comparison."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.errors import BadFrames
from calibration.frame_set import read_frame_set
from robot import open_rig
from tacsim import Action
from tacsim.record.images import encode_png
from tests.tacsim.record.replayed import picture
from tests.tacsim.record.test_ros_bag import write_bag


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    frames = []
    for k in range(3):
        image = picture(5, (60, 80))
        image[20:30, 20 : 20 + 5 * k] = 200  # more and more is touched
        frames.append(("png", cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()))
    return write_bag(tmp_path / "drive.mcap", {"/left": frames, "/right": frames[::-1]})


def test_a_rig_plays_a_topic(bag: Path) -> None:
    chosen = [f"sensors.finger.source={bag}", "sensors.finger.topic=/left"]
    with open_rig("replay", overrides=chosen) as rig:
        assert rig.spec.period == pytest.approx(0.02)
        first = rig.reset(0)
        observed, _ = rig.step(Action())
    assert np.all(first.tactile["finger"].image == 128) and observed.tactile["finger"].image.max() > 128


def test_a_comparison_reads_a_topic(bag: Path) -> None:
    untouched = bag.with_name("untouched.png")
    untouched.write_bytes(encode_png(picture(5, (60, 80))))
    frames = read_frame_set(bag, untouched, "/right")
    assert [frame.name for frame in frames.frames] == ["message 0", "message 1", "message 2"]
    assert (frames.frames[0].image[25, 25] == 200).all()
    with pytest.raises(BadFrames, match="several topics with compressed pictures: /left, /right"):
        read_frame_set(bag)

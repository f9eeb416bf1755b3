"""Which frames of two sides belong together: by name, in order, or refused."""

from __future__ import annotations

from dataclasses import replace

import pytest

from calibration.compare.compare import Pairing, pair_frames
from calibration.errors import BadFrames
from calibration.frame_set import Frame, FrameSet


def test_names_pair_before_the_order_does(real: FrameSet) -> None:
    turned = replace(real, frames=real.frames[::-1])
    couples, said = pair_frames(turned, real, Pairing.auto)
    assert said == []
    assert all(one.name == two.name for one, two in couples)
    in_order, _ = pair_frames(turned, real, Pairing.order)
    assert in_order[0][0].name == "press_4.png" and in_order[0][1].name == "press_0.png"


def test_endings_of_names_do_not_matter(real: FrameSet) -> None:
    jpeg = replace(real, frames=tuple(replace(frame, name=frame.name.replace(".png", ".JPG")) for frame in real.frames))
    couples, said = pair_frames(jpeg, real, Pairing.auto)
    assert said == [] and len(couples) == 5


def test_other_names_are_paired_in_order_and_it_says_so(real: FrameSet) -> None:
    named = replace(real, frames=tuple(replace(frame, name=f"x{k}.png") for k, frame in enumerate(real.frames)))
    couples, said = pair_frames(named, real, Pairing.auto)
    assert [two.name for _, two in couples] == [frame.name for frame in real.frames]
    assert said == ["paired in order: the names differ"]


def test_counts_that_differ_are_refused_unless_names_decide(real: FrameSet) -> None:
    fewer = replace(real, frames=real.frames[:3])
    with pytest.raises(BadFrames, match=r"has 3 frames, real 5.*3 names are in both.*--pair name"):
        pair_frames(fewer, real, Pairing.auto)
    couples, said = pair_frames(fewer, real, Pairing.name)
    assert len(couples) == 3
    assert said == ["2 frames have no partner of their name and are left out"]
    with pytest.raises(BadFrames, match="--pair order"):
        pair_frames(replace(fewer, frames=(Frame("else.png", real.reference),)), real, Pairing.name)


def test_folders_that_lack_different_pictures_are_not_paired_in_order(real: FrameSet) -> None:
    """As many pictures on both sides, but a press without its picture in each: order would pair strangers."""
    named = [Frame(f"press_{k}.png", frame.image) for k, frame in enumerate(real.frames)]
    some, others = replace(real, name="a", frames=tuple(named[1:])), replace(real, name="b", frames=tuple(named[:-1]))
    last = len(named) - 1
    with pytest.raises(
        BadFrames, match=rf"a alone has number {last}; b alone has number 0: .*--pair name.*--pair order"
    ):
        pair_frames(some, others, Pairing.auto)
    assert len(pair_frames(some, others, Pairing.name)[0]) == last - 1
    assert len(pair_frames(some, others, Pairing.order)[0]) == last

"""Recordings whose pictures and rows are numbered: what belongs together, and what is refused."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tacsim.interface import EndOfEpisode
from tacsim.record.episode import EpisodeError
from tacsim.record.images import encode_png
from tacsim.record.replay import ReplayArm, ReplayClock, ReplaySensor, match_sources
from tests.tacsim.record.replayed import arm_facts, picture, sensor_facts


def tables(folder: Path, numbers: list[int], header: str = "frame", separator: str = ",") -> Path:
    """A table whose force is its row's number."""
    path = folder / "numbered.csv"
    rows = [f"{number}{separator}{number}" for number in numbers]
    path.write_text("\n".join([f"{header}{separator}force_N", *rows]) + "\n")
    return path


def numbered(folder: Path, names: list[str]) -> Path:
    """Pictures whose red is 10 times the last number in the name before the ending."""
    path = folder / "numbered"
    path.mkdir()
    for name in names:
        (path / name).write_bytes(encode_png(picture(int(re.findall(r"\d+", name)[-1]))))
    return path


def matched(pictures: Path, table: Path, **more: object) -> list[tuple[int, int]]:
    """Red / 10 of each picture, and the force of the same tick."""
    clock = ReplayClock(0.1)
    sensor = ReplaySensor(sensor_facts(pictures, **more), "finger", clock)
    arm = ReplayArm(arm_facts(table, width_column=None), "gripper", clock)
    match_sources({"finger": sensor}, {"gripper": arm})
    found = []
    while True:
        try:
            frame = sensor.read(0)
        except EndOfEpisode:
            return found
        found.append((round(int(frame.image[0, 0, 0]) / 10), -int(arm.state().wrench[2])))
        assert arm.state().time == pytest.approx(clock.now())
        clock.tick()


@pytest.mark.parametrize(
    ("names", "header", "separator"),
    [
        ([f"{k:03d}.png" for k in (0, 1, 3, 4)], "frame", ","),  # in the middle
        ([f"{k:03d}.png" for k in (1, 2, 3, 4)], "frame", ";"),  # at the beginning
        ([f"img{k}.png" for k in (0, 1, 2)], "index", "\t"),  # at the end, without leading zeros
        ([f"2024-05-01_run3_{1700 + 37 * k}_{k:02d}.png" for k in (0, 2, 4)], "Frame", ","),  # several numbers
    ],
)
def test_pictures_and_rows_belong_together_by_number(
    tmp_path: Path, names: list[str], header: str, separator: str
) -> None:
    found = matched(numbered(tmp_path, names), tables(tmp_path, list(range(5)), header, separator))
    assert found == [(int(re.findall(r"\d+", name)[-1]),) * 2 for name in names]


def test_unnumbered_reference_picture_is_no_frame_of_table(tmp_path: Path) -> None:
    pictures = numbered(tmp_path, ["0.png", "1.png", "3.png"])
    (pictures / "background.png").write_bytes(encode_png(picture(0)))
    table = tables(tmp_path, [0, 1, 2, 3])
    assert matched(pictures, table, reference=str(pictures / "background.png")) == [(0, 0), (1, 1), (3, 3)]
    with pytest.raises(EpisodeError, match="1 of 4 names have no number"):
        matched(pictures, table)


@pytest.mark.parametrize(
    ("names", "numbers", "header", "message"),
    [
        (["0.png", "1.png", "3.png"], [0, 1, 2, 3], "t", r"has 3 \(missing in its numbers: 2\); .*csv has 4"),
        (["a.png0.png", "b1.png", "c2.png"], [0, 1, 2, 3], "frame", r"numbered has 3; .* has 4.*column `frame`"),
        (["0.png", "1.png", "2.png", "3.png"], [0, 1, 3], "frame", "has number 2, which .*csv lacks"),
        (["1.png", "2.png", "3.png"], [0, 1, 2], "frame", r"has number 3, which .* \(its numbers go from 0 to 2\)"),
    ],
)
def test_pictures_and_rows_that_may_not_belong_together(
    tmp_path: Path, names: list[str], numbers: list[int], header: str, message: str
) -> None:
    with pytest.raises(EpisodeError, match=message):
        matched(numbered(tmp_path, names), tables(tmp_path, numbers, header))


def test_a_table_longer_than_a_video_is_refused_unless_it_is_numbered(video: Path, tmp_path: Path) -> None:
    assert [force for _, force in matched(video, tables(tmp_path, list(range(7))))] == [0, 1, 2, 3, 4]
    with pytest.raises(EpisodeError, match=r"v\.avi has 5; .*csv has 7"):
        matched(video, tables(tmp_path, list(range(7)), "t"))


def test_a_gripper_s_speed_goes_by_the_numbers_of_its_rows(tmp_path: Path) -> None:
    (tmp_path / "g.csv").write_text("frame,force_N,gripper_width_m\n0,1,0.05\n3,1,0.02\n")
    clock = ReplayClock(0.1)
    arm = ReplayArm(arm_facts(tmp_path / "g.csv"), "upper", clock)
    clock.tick()
    assert arm.state().twist[2] == pytest.approx(-0.015 / 0.3)


def test_two_sensors_must_have_the_same_pictures(tmp_path: Path) -> None:
    clock, sensors = ReplayClock(0.1), {}
    for side, names in (("left", ["0.png", "1.png", "2.png"]), ("right", ["0.png", "2.png", "3.png"])):
        (tmp_path / side).mkdir()
        sensors[side] = ReplaySensor(sensor_facts(numbered(tmp_path / side, names)), side, clock)
    with pytest.raises(EpisodeError, match=r"left/numbered has number 1, which .*; .*right/numbered has number 3"):
        match_sources(sensors, {})

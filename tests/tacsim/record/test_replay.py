"""Recordings behind the contract of a rig: episodes, folders of pictures, videos, CSV files of a gripper."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tacsim.interface import Arm, Clock, EndOfEpisode, Pose, TactileFrame, TactileSource
from tacsim.record.episode import EpisodeError, EpisodeMeta, Step
from tacsim.record.images import encode_png, reference_attachments
from tacsim.record.replay import ReplayArm, ReplayClock, ReplaySensor, recorded_period
from tacsim.record.sources import list_pictures, select_name
from tacsim.record.writer import Recorder
from tests.tacsim.record.replayed import arm_facts, picture, sensor_facts


@pytest.fixture
def episode(tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step]) -> Path:
    path = tmp_path / "e.mcap"
    with Recorder(path, meta) as recorder:
        for k in range(3):
            recorder.write(make_step(k))
    return path


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "grip.csv"
    path.write_text("frame,force_N,gripper_width_m\n0,0.5,0.050\n1,2.0,0.048\n2,3.0,0.047\n")
    return path


def test_an_episode_replays_sensors_and_arms_together(episode: Path, make_step: Callable[..., Step]) -> None:
    clock = ReplayClock(0.1)
    sensor: TactileSource = ReplaySensor(sensor_facts(episode, arm="upper"), "upper", clock)
    arm: Arm = ReplayArm(arm_facts(episode), "upper", clock)
    ticking: Clock = clock
    for k in range(3):
        step = make_step(k)
        frame, state = sensor.read(1.0), arm.state()
        surface = frame.surface
        assert surface is not None
        assert np.array_equal(frame.image, step.frames["upper"].image)
        assert np.array_equal(surface.height, step.frames["upper"].surface.height)  # type: ignore[union-attr]
        assert frame.index == 3 * k
        assert np.array_equal(state.wrench, step.arms["upper"].wrench)
        assert np.array_equal(state.pose.position, step.arms["upper"].pose.position)
        # as old as it was when recorded
        assert clock.now() == pytest.approx(0.1 * k)
        assert clock.now() - frame.time == pytest.approx(0.0123456789)
        assert clock.now() - state.time == pytest.approx(1e-3)
        assert arm.command(Pose()) is None
        assert np.array_equal(sensor.read(1.0).image, frame.image)  # the same until the next tick
        ticking.tick()
    with pytest.raises(EndOfEpisode, match="has 3 frames"):
        sensor.read(1.0)
    with pytest.raises(EndOfEpisode):
        arm.state()
    clock.rewind()
    assert np.array_equal(sensor.read(1.0).image, make_step(0).frames["upper"].image)
    sensor.close()
    arm.close()


def test_height_and_flow_are_promised_only_if_recorded(episode: Path) -> None:
    specs = {
        name: ReplaySensor(sensor_facts(episode), name, ReplayClock(0.1)).spec for name in ("lower", "upper", "side")
    }
    assert {name: (spec.height, spec.flow) for name, spec in specs.items()} == {
        "lower": (True, True),
        "upper": (True, False),
        "side": (False, False),
    }
    assert specs["side"].image_shape == (24, 32)
    assert specs["side"].arm is None


def test_names_that_an_episode_has_not(episode: Path) -> None:
    with pytest.raises(EpisodeError, match=r"no sensor 'left'; the recording has: lower, upper, side"):
        ReplaySensor(sensor_facts(episode), "left", ReplayClock(0.1))
    with pytest.raises(EpisodeError, match=r"which sensor\? Name one; the recording has: lower, upper, side"):
        select_name(["lower", "upper", "side"], "", Path("a.mcap"), "sensor")
    with pytest.raises(EpisodeError, match=r"no arm 'left'; the recording has: lower, upper"):
        ReplayArm(arm_facts(episode), "left", ReplayClock(0.1))


def test_the_only_sensor_of_an_episode_goes_by_any_name(
    tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step]
) -> None:
    spec = replace(meta.spec, sensors={"side": meta.spec.sensors["side"]}, arms=("upper",))
    step = make_step(0)
    blank = TactileFrame(np.full((24, 32, 3), 9, np.uint8), time=0.0, index=0)
    config = replace(meta, spec=spec, attachments=reference_attachments({"side": blank}))
    with Recorder(tmp_path / "one.mcap", config) as recorder:
        recorder.write(replace(step, frames={"side": step.frames["side"]}, arms={"upper": step.arms["upper"]}))
    sensor = ReplaySensor(sensor_facts(tmp_path / "one.mcap"), "finger", ReplayClock(0.1))
    assert np.array_equal(sensor.read(0).image, step.frames["side"].image)
    assert (sensor.reference().image == 9).all()
    arm = ReplayArm(arm_facts(tmp_path / "one.mcap"), "finger", ReplayClock(0.1))
    assert np.array_equal(arm.state().twist, step.arms["upper"].twist)


def test_a_folder_is_read_in_natural_order(folder: Path) -> None:
    clock = ReplayClock(0.1)
    sensor = ReplaySensor(sensor_facts(folder), "lower", clock)
    assert sensor.spec.image_shape == (20, 30)
    assert not sensor.spec.height
    seen = []
    for k in range(4):
        frame = sensor.read(0)
        assert frame.time == clock.now() == pytest.approx(0.1 * k)
        assert frame.index == k
        seen.append(int(frame.image[0, 0, 0]))
        assert frame.image[0, 0, 1:].tolist() == [100, 200]
        clock.tick()
    assert seen == [10, 20, 90, 100]
    with pytest.raises(EndOfEpisode):
        sensor.read(0)
    assert sensor.reference().image[0, 0, 0] == 10
    assert sensor.reference().index == 0


def test_a_reference_of_the_rig_file_wins(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "bare.png").write_bytes(encode_png(picture(7)))
    sensor = ReplaySensor(sensor_facts(folder, reference=str(tmp_path / "bare.png")), "lower", ReplayClock(0.1))
    assert sensor.reference().image[0, 0, 0] == 70
    (tmp_path / "bare.png").write_bytes(encode_png(picture(7, (8, 8))))
    with pytest.raises(EpisodeError, match=r"sensors.lower.reference: 8 x 8 pixels, but .* have 30 x 20"):
        ReplaySensor(sensor_facts(folder, reference=str(tmp_path / "bare.png")), "lower", ReplayClock(0.1))


def test_folders_that_cannot_be_replayed(folder: Path, tmp_path: Path) -> None:
    def refused(match: str, path: Path = folder) -> None:
        with pytest.raises(EpisodeError, match=match):
            ReplaySensor(sensor_facts(path), "lower", ReplayClock(0.1))

    (tmp_path / "empty").mkdir()
    refused("no pictures in this folder", tmp_path / "empty")
    refused("no such file or folder", tmp_path / "missing")
    refused(r"notes.txt: no recording; give an episode", folder / "notes.txt")
    with pytest.raises(EpisodeError, match=r"--set sensors.lower.source=PATH"):
        ReplaySensor(sensor_facts(None), "lower", ReplayClock(0.1))
    (folder / "frame_11.png").write_bytes(encode_png(picture(1, (20, 31))))
    refused(r"frame_11.png: 31 x 20 pixels, but frame_1.png has 30 x 20")
    (folder / "frame_11.png").write_bytes(b"not a picture")
    refused(r"frame_11.png: no readable picture")
    (folder / "frame_11.png").unlink()
    (folder / "frame_1.jpg").mkdir()
    refused(r"frame_1.jpg: no readable picture")


def test_a_picture_that_breaks_off_is_named_each_time(folder: Path) -> None:
    rng = np.random.default_rng(0)
    data = encode_png(rng.integers(0, 256, (20, 30, 3), dtype=np.uint8))
    (folder / "frame_2.png").write_bytes(data[: len(data) // 2])
    clock = ReplayClock(0.1)
    sensor = ReplaySensor(sensor_facts(folder), "lower", clock)
    sensor.read(0)
    clock.tick()
    for _ in range(2):
        with pytest.raises(EpisodeError, match=r"frame_2.png: no readable picture"):
            sensor.read(0)


def test_pictures_beyond_the_limits(folder: Path) -> None:
    for path in folder.glob("*.png"):
        path.unlink()
    for columns in (5000, 100_000):
        header = b"IHDR" + struct.pack(">IIBBBBB", columns, 5000, 8, 2, 0, 0, 0)
        chunk = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
        (folder / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk + bytes(100))
        with pytest.raises(EpisodeError, match=r"bomb\.png"):
            ReplaySensor(sensor_facts(folder), "lower", ReplayClock(0.1))
    deep = cv2.imencode(".png", np.full((20, 30), 40_000, np.uint16))[1].tobytes()
    (folder / "bomb.png").write_bytes(deep)
    with pytest.raises(EpisodeError, match="8 bits a channel"):
        ReplaySensor(sensor_facts(folder), "lower", ReplayClock(0.1))


def test_a_video_gives_rgb_at_one_frame_a_tick(video: Path) -> None:
    assert recorded_period(sensor_facts(video), "lower") == pytest.approx(1 / 25)
    clock = ReplayClock(1 / 25)
    sensor = ReplaySensor(sensor_facts(video), "lower", clock)
    assert sensor.spec.image_shape == (48, 64)
    for k in range(5):
        frame = sensor.read(0)
        assert frame.time == pytest.approx(k / 25)
        assert np.abs(frame.image.astype(int) - picture(k, (48, 64))).max() <= 8  # JPEG loses a little
        clock.tick()
    with pytest.raises(EndOfEpisode, match="has 5 frames"):
        sensor.read(0)


def test_videos_that_cannot_be_replayed(video: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty.avi"
    cv2.VideoWriter(str(empty), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48)).release()
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "cut.avi").write_bytes(video.read_bytes()[:600])
    for path in (empty, tmp_path / "text.mp4", tmp_path / "cut.avi"):
        with pytest.raises(EpisodeError, match=path.name):
            ReplaySensor(sensor_facts(path), "lower", ReplayClock(0.1))
    with pytest.raises(EpisodeError, match="no such file"):
        ReplaySensor(sensor_facts(tmp_path / "missing.avi"), "lower", ReplayClock(0.1))


def test_the_period_of_a_recording(episode: Path, folder: Path) -> None:
    assert recorded_period(sensor_facts(episode), "lower") == 0.1
    assert recorded_period(sensor_facts(folder, fps=50), "lower") == pytest.approx(0.02)


def test_a_gripper_table_gives_force_and_pose(table: Path) -> None:
    clock = ReplayClock(0.5)
    upper, lower = (ReplayArm(arm_facts(table), name, clock) for name in ("upper", "lower"))
    assert upper.state().wrench.tolist() == [0, 0, -0.5, 0, 0, 0]
    assert upper.state().twist.tolist() == [0] * 6
    clock.tick()
    state = upper.state()
    assert state.wrench[2] == -2.0
    assert state.pose.position.tolist() == [0, 0, 0.024]
    assert lower.state().pose.position.tolist() == [0, 0, -0.024]
    assert state.pose.quaternion.tolist() == [1, 0, 0, 0]  # faces down
    assert lower.state().pose.quaternion.tolist() == [0, 0, 0, 1]
    assert state.twist[2] == pytest.approx(-0.001 / 0.5)  # closing: the upper finger goes down
    assert lower.state().twist[2] == pytest.approx(+0.001 / 0.5)
    assert state.joints is None
    assert state.time == 0.5
    clock.tick()
    clock.tick()
    with pytest.raises(EndOfEpisode):
        upper.state()


def test_a_table_without_opening(tmp_path: Path) -> None:
    (tmp_path / "f.csv").write_text("\ufeff pull , t\n1.5, 0\n")
    arm = ReplayArm(arm_facts(tmp_path / "f.csv", force_column="pull", width_column=None), "upper", ReplayClock(0.1))
    assert arm.state().wrench[2] == -1.5
    assert arm.state().pose.position.tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"frame,force,width\n0,1,2\n", "no column 'force_N'; it has: frame, force, width"),
        (b"force_N,gripper_width_m\n", "a header without rows"),
        (b"", r"no column 'force_N'; it has: \(nothing\)"),
        (b"force_N,gripper_width_m\n1,2\nx,2\n", r":3: column 'force_N': 'x' is not a finite number"),
        (b"force_N,gripper_width_m\n1,nan\n", r":2: column 'gripper_width_m': 'nan'"),
        (b"force_N,gripper_width_m\n1\n", r":2: column 'gripper_width_m': ''"),
        (b"frame,force_N,gripper_width_m\n0,1,2\n0,1,2\n", r":3: frame 0 in row 1"),
        (b"index,force_N,gripper_width_m\n0,1,2\n1.5,1,2\n", r":3: index 1.5 in row 1"),
        (b"\xff\xfe\x00", "no readable CSV"),
        (b"force_N,gripper_width_m\n" + b"1" * 200_000 + b",2\n", "no readable CSV"),
    ],
)
def test_tables_that_cannot_be_replayed(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "f.csv").write_bytes(content)
    with pytest.raises(EpisodeError, match=message):
        ReplayArm(arm_facts(tmp_path / "f.csv"), "upper", ReplayClock(0.1))


def test_sources_of_arms_that_are_none(tmp_path: Path, folder: Path) -> None:
    for source, message in (
        (None, "arms.upper.source"),
        (tmp_path / "no.csv", "no such file"),
        (folder, "no such file"),
    ):
        with pytest.raises(EpisodeError, match=message):
            ReplayArm(arm_facts(source), "upper", ReplayClock(0.1))
    with pytest.raises(EpisodeError, match=r"no record of an arm; give an episode \(.mcap\) or a .csv"):
        ReplayArm(arm_facts(folder / "notes.txt"), "upper", ReplayClock(0.1))


def test_an_episode_without_steps(tmp_path: Path, meta: EpisodeMeta) -> None:
    with Recorder(tmp_path / "none.mcap", meta):
        pass
    with pytest.raises(EpisodeError, match="a recording without frames"):
        ReplaySensor(sensor_facts(tmp_path / "none.mcap"), "lower", ReplayClock(0.1))


def test_a_replay_can_be_recorded_again(episode: Path, tmp_path: Path, meta: EpisodeMeta) -> None:
    """Its first frame is older than the replay's clock: a time below 0 that has to survive too."""
    clock = ReplayClock(0.1)
    frame = ReplaySensor(sensor_facts(episode), "lower", clock).read(0)
    assert frame.time < 0
    with Recorder(tmp_path / "again.mcap", meta) as recorder:
        recorder.write(Step(index=0, time=clock.now(), frames={"lower": frame}, arms={}))
    assert recorder.error is None
    again = ReplaySensor(sensor_facts(tmp_path / "again.mcap"), "lower", ReplayClock(0.1)).read(0)
    assert again.time == frame.time


def test_a_period_of_nothing() -> None:
    for period in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="above 0 s"):
            ReplayClock(period)


def test_hidden_files_are_skipped(folder: Path) -> None:
    for name in ("._frame_1.png", ".DS_Store", "Thumbs.db", ".hidden.jpg"):
        (folder / name).write_bytes(b"\0\5\x16\7junk")
    assert len(list_pictures(folder)) == 4


def test_folder_without_pictures_reports_other_files(tmp_path: Path) -> None:
    (tmp_path / "a.tiff").write_bytes(b"II*\0")
    with pytest.raises(EpisodeError, match=r"but 1 like a\.tiff; save them as PNG with 8 bits"):
        list_pictures(tmp_path)
    (tmp_path / "bag_0.mcap").write_bytes(b"")
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    with pytest.raises(EpisodeError, match=r"folder of a ROS 2 bag \(bag_0\.mcap\)"):
        list_pictures(tmp_path)

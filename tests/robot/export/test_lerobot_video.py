"""Pictures of a data set as videos: where LeRobot looks for them, as exact as is said; nothing left of what fails."""

from __future__ import annotations

import json
import resource
import subprocess
from importlib import util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from robot.export import lerobot_video
from robot.export.lerobot_files import DataSet
from robot.export.lerobot_mapping import Feature, ImageCounts
from tacsim.record.images import encode_png
from tests.robot.cli.invoked import START, environment, tacsim
from tests.robot.export.lerobot_reader import read_dataset
from tests.robot.export.made_up import record

needs_av = pytest.mark.skipif(util.find_spec("av") is None, reason="needs the extra 'video'")
IMAGES = [f"observation.images.{name}" for name in ("lower", "upper")]


pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.mark.skipif(util.find_spec("av") is not None, reason="PyAV is here")
def test_without_av_it_says_what_to_install(tmp_path: Path) -> None:
    path, _ = record("a.mcap", 2)
    done = tacsim("export", "lerobot", str(path), "--out", "set", "--video")
    assert done.exit_code == 2 and "pip install 'tacsim[video]'" in done.stderr.replace("\n", " ")
    assert sorted(tmp_path.iterdir()) == [path.absolute()]


@needs_av
def test_only_the_pictures_differ_and_by_what_the_data_set_says(tmp_path: Path) -> None:
    paths = [str(record("a.mcap", 5)[0]), str(record("b.mcap", 4, seed=1)[0])]
    assert tacsim("export", "lerobot", *paths, "--out", "exact").exit_code == 0
    done = tacsim("export", "lerobot", *paths, "--out", "shown", "--video")
    assert done.exit_code == 0, done.output
    _, exact = read_dataset(tmp_path / "exact")
    info, shown = read_dataset(tmp_path / "shown")
    assert [name for name, each in info["features"].items() if each["dtype"] == "video"] == IMAGES
    assert (tmp_path / f"shown/videos/{IMAGES[0]}/chunk-000/file-000.mp4").is_file()
    for name in exact.keys() - set(IMAGES):
        assert exact[name].tobytes() == shown[name].tobytes(), name
    told = json.loads(Path("shown/meta/tacsim.json").read_text())["video_error"]
    for name in IMAGES:
        error = shown[name].astype(int) - exact[name]
        signal = exact[name].astype(int) - 128
        contact = np.abs(signal) > 10
        assert told[name]["rms"] == pytest.approx(np.sqrt((error**2).mean()), abs=1e-4)
        assert told[name]["rms_in_contact"] == pytest.approx(np.sqrt((error[contact] ** 2).mean()), abs=1e-4)
        assert told[name]["signal_in_contact"] == pytest.approx(np.sqrt((signal[contact] ** 2).mean()), abs=1e-4)
        assert told[name]["most"] == np.abs(error).max() and 0.0 < told[name]["rms"] < 4.0  # of pictures all noise
    stats = [json.loads((tmp_path / folder / "meta/stats.json").read_text()) for folder in ("exact", "shown")]
    assert stats[0] == stats[1]  # of the pictures themselves


def smooth(count: int, seed: int) -> list[NDArray[np.uint8]]:
    """Pictures with steep coloured edges, as a contact has."""
    x, y = np.meshgrid(np.arange(70.0), np.arange(50.0))
    found = []
    for k in range(count):
        edge = np.tanh((np.hypot(x - 35, y - 25) - 8 - k - seed) / 2)
        found.append(np.stack([128 + 90 * edge * np.cos(x / 9 + c) for c in range(3)], -1).round().astype(np.uint8))
    return found


def write(folder: Path, episodes: list[list[NDArray[np.uint8]]], fps: float = 10, **more: Any) -> DataSet:
    folder.mkdir()
    feature = Feature("image", (50, 70, 3), ("height", "width", "channels"))
    data = DataSet(folder, fps, "r", {"observation.images.a": feature}, video=True, **more)
    for each in episodes:
        counts = ImageCounts()
        for picture in each:
            counts.add(picture)
        png = [encode_png(picture) for picture in each]
        data.add({"observation.images.a": png}, {"observation.images.a": counts.statistics()}, "t")
    data.close()
    return data


@needs_av
def test_episodes_lie_one_behind_the_other_and_files_are_followed_by_others(tmp_path: Path) -> None:
    """The error is below that of the same pictures with colours of half resolution and nothing else lost: 1.57 grey
    levels (PIL 12.0, JPEG 4:2:0 at quality 100)."""
    episodes = [smooth(7 + k, k) for k in range(5)]
    data = write(tmp_path / "one", episodes)
    _, columns = read_dataset(tmp_path / "one")
    told = data.videos["observation.images.a"].error.summarise()
    error = columns["observation.images.a"].astype(int) - np.concatenate(episodes)
    assert told["most"] == np.abs(error).max() and told["rms"] < 1.57
    small = write(tmp_path / "many", episodes, video_size=0.01)
    _, again = read_dataset(tmp_path / "many")
    files = sorted((tmp_path / "many/videos").rglob("*.mp4"))
    assert [path.name for path in files] == [f"file-{k:03d}.mp4" for k in range(len(files))] and len(files) > 1
    assert again["observation.images.a"].shape == columns["observation.images.a"].shape
    assert small.videos["observation.images.a"].info["video.crf"] == 10


@needs_av
def test_the_same_recordings_make_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write(tmp_path / name, [smooth(9, 0)])
    (a, b) = (next((tmp_path / name).rglob("*.mp4")).read_bytes() for name in ("a", "b"))
    assert a == b


@needs_av
def test_an_encoder_that_is_missing_is_told_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, _ = record("a.mcap", 2)
    monkeypatch.setattr(lerobot_video, "ENCODER", "libnone")
    done = tacsim("export", "lerobot", str(path), "--out", "set", "--video")
    assert done.exit_code == 2 and "without the encoder libnone" in done.stderr.replace("\n", " ")
    assert sorted(tmp_path.iterdir()) == [path.absolute()]


@needs_av
def test_an_encoder_that_fails_leaves_nothing_half(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, _ = record("a.mcap", 4)
    monkeypatch.setattr(lerobot_video, "PIXELS", "rgb24")  # which libx264 refuses once it is opened
    done = tacsim("export", "lerobot", str(path), "--out", "set", "--video")
    assert done.exit_code == 1 and "the encoder libx264 failed" in done.stderr.replace("\n", " "), done.stderr
    assert sorted(tmp_path.iterdir()) == [path.absolute()]


@needs_av
def test_a_full_disk_leaves_nothing_half(tmp_path: Path) -> None:
    path, _ = record("a.mcap", 20)
    process = subprocess.run(
        [*START, "export", "lerobot", str(path), "--out", "set", "--video", "--no-maps"],
        env=environment(),
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000)),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert process.returncode == 1 and "error: set: File too large" in process.stderr, process.stderr
    assert sorted(tmp_path.iterdir()) == [path.absolute()]

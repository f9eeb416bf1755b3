"""LeRobot reads an export as it was written: pictures, maps, states, actions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.plugins.commands import LIMIT  # noqa: F401  # skips where LeRobot is not installed
from tests.robot.cli.invoked import tacsim
from tests.robot.export.lerobot_reader import read_dataset
from tests.robot.export.made_up import record


def loaded(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    items = LeRobotDataset("me/set", root=folder)
    return [items[row] for row in range(len(items))]


def picture(value: Any) -> NDArray[np.uint8]:
    """(H, W, 3) of LeRobot's (3, H, W) of 0..1."""
    return np.moveaxis(np.rint(255.0 * np.asarray(value)), 0, -1).astype(np.uint8)


def test_an_export_is_read_bit_for_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recordings = [record(str(tmp_path / "a.mcap"), 5)[0], record(str(tmp_path / "b.mcap"), 4, seed=1)[0]]
    folder = tmp_path / "set"
    assert tacsim("export", "lerobot", *recordings, "--out", folder).exit_code == 0
    info, columns = read_dataset(folder)  # which equals the recordings: tests/robot/export/test_lerobot.py
    items = loaded(folder, monkeypatch)
    assert len(items) == info["total_frames"] == 7
    for name, feature in info["features"].items():
        for row, item in enumerate(items):
            found = picture(item[name]) if feature["dtype"] == "image" else np.asarray(item[name])
            assert np.array_equal(found.reshape(columns[name][row].shape), columns[name][row]), (name, row)
    assert {item["task"] for item in items} and columns.keys() == info["features"].keys()


def test_a_video_is_off_by_what_the_data_set_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, _ = record(str(tmp_path / "a.mcap"), 5)
    for folder, how in (("exact", ()), ("shown", ("--video",))):
        assert tacsim("export", "lerobot", path, "--out", tmp_path / folder, *how).exit_code == 0
    _, exact = read_dataset(tmp_path / "exact")
    told = json.loads((tmp_path / "shown/meta/tacsim.json").read_text())["video_error"]
    items = loaded(tmp_path / "shown", monkeypatch)
    for name, error in told.items():
        off = np.stack([picture(item[name]) for item in items]).astype(int) - exact[name]
        # each decoder rounds colours in its own way
        assert np.sqrt((off**2).mean()) == pytest.approx(error["rms"], abs=0.05)

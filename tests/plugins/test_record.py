"""`lerobot-record`, unmodified, over mock UR arms: two episodes that are what the arms did."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
from PIL import Image
from pyarrow import parquet

from robot.open import load_with_task
from tacsim.gym.features import SCALES
from tests.plugins.commands import refused, rig_file, run
from tests.robot.rig.bare_rig import cameras_of

STEP = 0.1e-3


def options(rig: Path, out: Path) -> list[str]:
    return [
        *("--robot.type=tacsim", f"--robot.rig={rig}", "--robot.fps=10"),
        *("--teleop.type=tacsim", f"--teleop.rig={rig}", f"--teleop.step={STEP}", "--teleop.device=script"),
        *("--dataset.repo_id=me/set", f"--dataset.root={out}", "--dataset.single_task=press", "--dataset.fps=10"),
        *("--dataset.num_episodes=2", "--dataset.episode_time_s=2", "--dataset.reset_time_s=0.5"),
        *("--dataset.push_to_hub=false", "--dataset.video=false", "--play_sounds=false"),
    ]


def test_two_episodes_are_what_the_arms_did(tmp_path: Path) -> None:
    rig = rig_file(tmp_path, 61)
    with cameras_of(load_with_task(rig).config):
        run(tmp_path, "lerobot-record", *options(rig, tmp_path / "set"))
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    table = parquet.read_table(tmp_path / "set/data")
    columns = {name: np.stack(table[name].to_numpy()) for name in ("action", "observation.state", "episode_index")}
    assert (info["total_episodes"], info["fps"], info["robot_type"]) == (2, 10, "tacsim")
    names = info["features"]["observation.state"]["names"]
    asked = info["features"]["action"]["names"]
    assert [name for name in names if name.endswith(".pos")] == asked
    assert info["features"]["observation.images.west"]["shape"] == [64, 64, 3]
    action = columns["action"][:, asked.index("moved_z_west.pos")] * SCALES["moved"]
    assert np.allclose(np.diff(action[columns["episode_index"] == 0]), STEP, rtol=1e-3)
    state = columns["observation.state"][:, names.index("moved_z_west.pos")] * SCALES["moved"]
    assert np.all(np.diff(state) > -1e-6) and state[-1] > 0.5 * action[-1]  # it follows
    for value in table["observation.images.west"].to_pylist():
        picture = np.asarray(Image.open(io.BytesIO(value["bytes"])))
        assert picture.shape == (64, 64, 3) and np.abs(picture.astype(int) - 128).max() <= 2  # nothing touches


def test_what_does_not_fit_is_refused_in_words(tmp_path: Path) -> None:
    rig = rig_file(tmp_path, 63)
    said = refused(tmp_path, "lerobot-record", *options(rig, tmp_path / "set"), "--robot.fps=30")
    assert "control period of 100 ms, which is fps=10, not 30" in said
    assert not (tmp_path / "set").exists()

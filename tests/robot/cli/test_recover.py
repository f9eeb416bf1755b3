"""`tacsim recover`: what it says, and what is left when it cannot write."""

from __future__ import annotations

import resource
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tacsim.interface import RigSpec, SensorSpec, TactileFrame
from tacsim.record.episode import EpisodeMeta, Step
from tacsim.record.reader import read_episode
from tacsim.record.writer import Recorder
from tests.robot.cli.invoked import START, environment, tacsim

pytestmark = pytest.mark.usefixtures("empty_folder")
STEPS = 20


@pytest.fixture
def cut(tmp_path: Path) -> Path:
    """A recording that ends in the middle of its last step."""
    spec = RigSpec({"lower": SensorSpec((64, 64), False, False, None)}, (), truth=False, period=0.1)
    rng = np.random.default_rng(0)
    with Recorder("whole.mcap", EpisodeMeta("r", None, "p", 0, spec, {}, {"rig.yaml": b"name: r"})) as recorder:
        for k in range(STEPS + 1):
            frame = TactileFrame(rng.integers(0, 255, (64, 64, 3), np.uint8), time=0.1 * k, index=k)
            recorder.write(Step(k, 0.1 * k, {"lower": frame}, {}))
    data = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: data.index(b"tacsim.close") - 3000])
    return tmp_path / "cut.mcap"


def test_recover_cut_recording_reports_losses(cut: Path, tmp_path: Path) -> None:
    before = cut.read_bytes()
    result = tacsim("recover", "cut.mcap")
    assert result.exit_code == 0, result.output
    assert f"{STEPS} steps recovered; without:" in result.stdout
    assert "the end: the recording was cut off" in result.stdout and "cut.recovered.mcap" in result.stdout
    assert len(read_episode(tmp_path / "cut.recovered.mcap").steps) == STEPS
    assert cut.read_bytes() == before
    again = tacsim("recover", "cut.mcap")
    assert again.exit_code == 2 and "exists already; nothing is overwritten" in again.stderr
    assert tacsim("recover", "cut.mcap", "--out", "cut.mcap").exit_code == 2
    assert cut.read_bytes() == before
    assert "nothing to recover" in tacsim("recover", "cut.recovered.mcap").stdout
    shown = tacsim("replay", "cut.recovered.mcap", "--out", "r")
    assert shown.exit_code == 0 and f"The recording was cut off; {STEPS} steps could be read." in shown.stderr
    assert "its rig file does not fit this tacsim (clock: is missing" in " ".join(shown.stderr.split())


def test_recover_invalid_file_is_reported(tmp_path: Path) -> None:
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "text.mcap").write_text("hello")
    for name, words in (("empty", "is empty"), ("text", "not an MCAP file"), ("none", "no such file")):
        result = tacsim("recover", f"{name}.mcap")
        assert result.exit_code == 2 and words in result.stderr
    assert len(list(tmp_path.iterdir())) == 2


def test_recover_on_full_disk_leaves_no_file(cut: Path, tmp_path: Path) -> None:
    half = cut.stat().st_size // 2
    process = subprocess.run(
        [*START, "recover", "cut.mcap"],
        env=environment(),
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (half, half)),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert process.returncode == 1 and "cut.recovered.mcap: File too large" in process.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cut.mcap", "whole.mcap"]
    missing = tacsim("recover", "cut.mcap", "--out", "none/new.mcap")
    assert missing.exit_code == 2 and "none/new.mcap: No such file" in missing.stderr

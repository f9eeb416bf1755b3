"""`tacsim compare`: exit codes, messages, files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import Result

from calibration.bundle import write_bundle
from calibration.frame_set import FrameSet, read_frame_set
from tacsim.interface import RigSpec, SensorSpec, SurfaceMap, TactileFrame
from tacsim.record.episode import EpisodeMeta, Step
from tacsim.record.images import reference_attachments
from tacsim.record.writer import Recorder
from tests.calibration.presses import HiddenSensor
from tests.calibration.sources import blank, calibrated, changed, save, side
from tests.robot.cli.invoked import plain_text, tacsim


@pytest.fixture(scope="module")
def real() -> FrameSet:
    return side(HiddenSensor(3), name="real")


@pytest.fixture(scope="module")
def good(real: FrameSet) -> FrameSet:
    sensor = HiddenSensor(3)
    sensor.empty()
    return replace(side(sensor, name="good"), reference=real.reference, untouched=())


@pytest.fixture(autouse=True)
def folders(real: FrameSet, good: FrameSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TERM", "dumb")
    save(real, Path("real"))
    save(good, Path("sim"))


def compared(*words: object) -> Result:
    return tacsim("compare", *words)


def test_compare_writes_files_and_table() -> None:
    result = compared("sim", "real", "--out", "out")
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in Path("out").iterdir()) == ["compare.csv", "compare.html", "compare.json"]
    assert "contact NCC" in result.stdout and "null" in result.stdout and "floor" in result.stdout
    assert "gradient" not in result.stdout  # not known without calibrations
    config = json.loads(Path("out/compare.json").read_text())
    assert config["overall"]["contact_mae"]["mean"] < 3
    assert compared("sim", "real", "--out", "out").exit_code == 2  # nothing is overwritten


@pytest.mark.slow
def test_compare_limits_set_exit_code() -> None:
    kept = tacsim(
        "compare", "sim", "real", "--fail-above", "contact_mae=5", "--fail-below", "contact_ncc=0.9", "--out", "kept"
    )
    assert kept.exit_code == 0, kept.output
    above = compared("sim", "real", "--fail-above", "contact_mae=0.5", "--out", "above")
    assert above.exit_code == 1
    assert "contact_mae is 1." in plain_text(above.output) and "above 0.5" in plain_text(above.output)
    assert Path("above/compare.html").is_file()  # to see why
    below = compared("sim", "real", "--fail-below", "contact_ssim=0.9999", "--out", "below")
    assert below.exit_code == 1 and "below 0.9999" in plain_text(below.output)


@pytest.mark.slow
def test_compare_blank_image_fails_limit(real: FrameSet) -> None:
    save(blank(real), Path("blank"))
    assert compared("blank", "real", "--fail-below", "ssim=0.8", "--out", "a").exit_code == 0
    assert compared("blank", "real", "--fail-below", "contact_ncc=0.5", "--out", "b").exit_code == 1


@pytest.mark.parametrize(
    ("limit", "words"),
    [
        ("magic=3", "'magic' is not a figure; allowed: mae, psnr"),
        ("contact_mae", "'contact_mae'"),
        ("contact_mae=low", "'contact_mae=low'"),
        ("contact_mae=nan", "is not METRIC=VALUE"),
        ("height_rmse=3 s", "'height_rmse=3 s'"),
        ("gradient_angle=3", "not measured in these frames: gradient_angle"),
        ("rho_gradient=1", "not measured in these frames: rho_gradient"),
    ],
)
def test_compare_invalid_limits_are_refused(limit: str, words: str) -> None:
    result = compared("sim", "real", "--fail-above", limit, "--out", "out")
    assert result.exit_code == 2
    assert words in plain_text(result.output)
    assert not Path("out").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("nowhere", "real"), "nowhere: no such file or folder"),
        (("sim", "nowhere"), "nowhere: no such file or folder"),
        (("sim", "real", "--calibration-b", "nowhere"), "nowhere"),
        (("sim", "real", "--reference-a", "none.png"), "none.png"),
        (("sim", "real", "--corners-a", "1,2 3,4"), "is not four points"),
        (("sim", "real", "--corners-a", "9,9 9,5 5,5 5,9"), "no convex quadrangle"),
        (("sim", "real", "--set", "preset=draft"), "--set changes a scene, but A is no scene: sim"),
        (("press", "real"), "give B's calibration (--calibration-b)"),
        (("press", "real", "--sensor-a", "x"), "A is the scene 'press'"),
    ],
)
def test_compare_invalid_input_is_reported(words: tuple[str, ...], message: str) -> None:
    result = compared(*words, "--out", "out")
    assert result.exit_code == 2
    assert message in plain_text(result.output)
    assert "Traceback" not in result.output
    assert not Path("out").exists()


def test_compare_different_counts_need_pair_name(real: FrameSet) -> None:
    Path("sim/press_4.png").unlink()
    refused = compared("sim", "real", "--out", "out")
    assert refused.exit_code == 2 and "--pair name" in plain_text(refused.output)
    named = compared("sim", "real", "--pair", "name", "--out", "out")
    assert named.exit_code == 0 and "no partner of their name" in plain_text(named.output)


@pytest.mark.slow
def test_compare_prints_warnings(good: FrameSet, real: FrameSet) -> None:
    save(changed(good, lambda image: np.ascontiguousarray(image[..., ::-1]), "all"), Path("bgr"))
    assert "red and blue look swapped" in plain_text(compared("bgr", "real", "--out", "a").output)
    save(blank(real), Path("blank"))
    assert "A: no contact" in plain_text(compared("blank", "real", "--out", "b").output)


@pytest.mark.slow
def test_compare_with_calibrations_adds_surfaces_and_invariance() -> None:
    calibration, reference = calibrated(HiddenSensor(3))
    Path("bundle").mkdir()
    write_bundle(Path("bundle"), calibration, reference)
    both = ("--calibration-a", "bundle", "--calibration-b", "bundle")
    result = compared("sim", "real", *both, "--invariance", "--fail-above", "height_rmse=0.05 mm", "--fail-above",
                    "rho_height=1", "--fail-above", "drift_gain_down=0.5", "--out", "out")  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "rho" in result.stdout and "gain −30 %" in result.stdout
    config = json.loads(Path("out/compare.json").read_text())
    assert config["overall"]["gradient_angle"]["mean"] < 3
    assert config["invariance"]["presses"] == 5
    Image.fromarray(reference[:100]).save("small.png")
    Path("small").mkdir()
    for name in ("background.png", "press_0.png"):
        Image.fromarray(reference[:100]).save(Path("small") / name)
    wrong = compared("small", "real", *both, "--pair", "name", "--out", "wrong")
    assert wrong.exit_code == 2
    assert "small is 260 x 100 px, the calibration of A is of 260 x 200" in plain_text(wrong.output)


@pytest.mark.slow
def test_compare_episode_uses_its_surfaces(real: FrameSet) -> None:
    surface = SurfaceMap(
        height=np.full((64, 64), 1e-4, dtype=np.float32), gradient=np.zeros((64, 64, 2), dtype=np.float32), flow=None
    )
    spec = RigSpec({"left": SensorSpec((200, 260), True, False, None)}, (), False, 0.1)
    references = {"left": TactileFrame(real.reference, time=0.0, index=0)}
    meta = EpisodeMeta(
        rig="made", task=None, policy="none", seed=0, spec=spec, versions={},
        attachments=reference_attachments(references),
    )  # fmt: skip
    with Recorder(Path("e.mcap"), meta) as recorder:
        for k, shot in enumerate(real.frames):
            frames = {"left": TactileFrame(shot.image, time=0.1 * k, index=k, surface=surface)}
            assert recorder.write(Step(index=k, time=0.1 * k, frames=frames, arms={}))
    read = read_frame_set(Path("e.mcap"))
    assert read.reference_from == "the recording's own"
    assert np.array_equal(read.reference, real.reference)
    assert len(read.frames) == 5 and read.frames[0].surface is not None
    result = compared("e.mcap", "real", "--out", "out")
    assert result.exit_code == 0, result.output
    assert json.loads(Path("out/compare.json").read_text())["overall"]["mae"]["mean"] == 0.0
    unknown = compared("real", "e.mcap", "--sensor-b", "left", "--out", "again")
    assert unknown.exit_code == 0, unknown.output

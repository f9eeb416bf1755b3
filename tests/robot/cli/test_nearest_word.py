"""Every wrong name is answered with the nearest right one."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.robot.cli.invoked import TINY, plain_text, tacsim

pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "nearest"),
    [
        ("rnu", "Did you mean 'run'?"),
        ("calibrate sensr", "Did you mean 'sensor'"),
        ("press sphere --dpth 1mm", "--depth"),
        ("press sphere --preset drft", "did you mean 'draft'?"),
        ("list rgi", "did you mean 'rig'?"),
        ("new scen mine", "did you mean 'scene'?"),
        ("bench pres", "did you mean 'press'?"),
        ("collect press --pose randm --out set", "did you mean 'random'?"),
        ("schema scen", "did you mean 'scene'?"),
        ("show gelsigt-mini", "did you mean 'gelsight-mini'?"),
        ("show arm.urr", "did you mean 'arm.ur'?"),
        ("run smi", "did you mean 'sim'?"),
        ("start mokc", "did you mean 'mock'?"),
        ("run --task squeze", "did you mean 'squeeze'?"),
        ("run --set sensors.upper.model=digt", "did you mean 'digit'?"),
        ("run --set sensors.uppr.model=digit", "did you mean 'upper'?"),
        ("run --set sensors.upper.driver=camra", "did you mean 'camera'?"),
        ("run --set arms.upper.driver=smi", "did you mean 'sim'?"),
        ("run --set scene.body.material=modeling-clay", "did you mean 'modelling-clay'?"),
        ("run --set scene.gel.materail.density=1000", "did you mean 'material'?"),
        ("run --set clock=sm", "did you mean 'sim'?"),
        ("press shpere", "did you mean 'sphere'?"),
        ("press ball", "did you mean 'sphere'?"),
        ("run simulation", "did you mean 'sim'?"),
        ("press sphere --sensor digt", "did you mean 'digit'?"),
        ("compare pres pictures", "did you mean 'press'?"),
        ("collect episodes sim --randomise sqeeze --out set", "did you mean 'squeeze'?"),
        ("collect episodes sim --policy randm --out set", "did you mean 'random'?"),
        ("evaluate sqeeze", "did you mean 'squeeze'?"),
        ("evaluate squeeze --policy techer", "did you mean 'teacher'?"),
        ("evaluate squeeze --policy teacher.onnx", "policy 'teacher.onnx': no such file"),
        ("transfer squeeze --policy lerned", "did you mean 'learned'?"),
        ("transfer squeeze --twin squeeze-twn", "did you mean 'squeeze-twin'?"),
        ("transfer ./mine.yaml", "has no twin of its own"),
        ("identify gel --scene pres x.csv", "did you mean 'press'?"),
        ("calibrate sensor x --kind min --ball-diameter 4mm", "did you mean 'mini'?"),
        ("calibrate sensor --camera mock/uper --kind mini --ball-diameter 4mm", "did you mean 'upper'?"),
        ("calibrate latency mock --arm uper --sensor upper", "did you mean 'upper'?"),
        ("mock --model ur5", "did you mean 'ur5e'?"),
    ],
)
def test_the_nearest_word_is_offered(command: str, nearest: str, tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    (tmp_path / "pictures").mkdir()
    done = tacsim(*command.split())
    assert done.exit_code == 2, done.output
    assert nearest in plain_text(done.stderr)


@pytest.mark.parametrize(
    ("policy", "right"),
    [
        ("scriptd", "scripted"), ("lerned", "learned"), ("nearby:atc", "act"), ("nearby:Pol.mak", None),
        ("move.cvs.csv", "move.csv"), ("min.onnx", "mine.onnx"),
    ],
)  # fmt: skip
def test_a_policy_of_a_run(tmp_path: Path, policy: str, right: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("robot.rig.sim_rig.make_world", lambda scene: pytest.fail("the simulation was opened"))
    for name in ("move.csv", "mine.onnx"):
        (tmp_path / name).touch()
    (tmp_path / "nearby.py").write_text("def act(observation): ...\nclass Pol: ...\n")
    done = tacsim("run", "--policy", policy, *TINY)
    assert done.exit_code == 2
    assert right is None or f"did you mean '{right}'?" in done.stderr


def test_a_file_of_code_is_no_policy_but_holds_one(tmp_path: Path) -> None:
    (tmp_path / "mine.py").touch()
    done = tacsim("run", "--policy", "mine.py")
    assert done.exit_code == 2 and "name what the file defines: 'mine:NAME'" in done.stderr


def test_a_rig_file(tmp_path: Path) -> None:
    """A key and a name in it, each at its line."""
    (tmp_path / "mine.yaml").write_text("extends: sim\nperod: 0.1\nsensors:\n  upper: {model: gelsight-min}\n")
    done = tacsim("run", "mine.yaml")
    assert done.exit_code == 2
    assert "mine.yaml:2: perod: unknown key" in done.stderr and "did you mean 'period'?" in done.stderr
    assert "mine.yaml:4: sensors.upper.model: no sensor" in done.stderr
    assert "did you mean 'gelsight-mini'?" in done.stderr


def test_nothing_near_is_offered_for_a_word_like_none() -> None:
    done = tacsim("list", "xylophone")
    assert done.exit_code == 2 and "did you mean" not in done.stderr

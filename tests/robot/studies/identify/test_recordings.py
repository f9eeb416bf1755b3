"""Recordings that are none, and the files that come out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibration.materials.checks import Finding
from calibration.materials.estimate import estimate_materials
from calibration.materials.fit import Noise, Point, Priors, signals_of
from robot.deploy.policy import load_policy
from robot.deploy.python_policy import PolicyNotFound
from robot.studies.identify import results
from robot.studies.identify.identify import Identified, parameters_of, predict_intervals
from robot.studies.identify.motions import MOTION_TEXTS, MOTIONS_FOR_PARAMETER, motions
from robot.studies.identify.recordings import BadRecording, Recordings, find_recordings
from robot.studies.identify.simulation import scene_with
from tacsim.config import load_rig, load_scene
from tacsim.interface import ArmState, Observation, Pose, RigSpec
from tacsim.pose import HALF_TURN_X
from tacsim.record.episode import EpisodeError

TABLE = "time,x,y,z,fx,fz\n0,0,0,0.0001,0,0\n1,0,0,-0.0002,0,-0.1\n2,0.001,0,-0.0004,0.1,-0.3\n"

GAPS = "time,x,y,z,fx,fz\n0,0,0,0.008,0,0\n1,0,0,0.0077,0,-0.1\n2,0.001,0,0.0075,0.1,-0.3\n"


def test_a_table_of_heights_and_forces(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(TABLE)
    press = Recordings(load_scene("press")).read(tmp_path / "a.csv")
    assert press.poses["indenter"][2].position == pytest.approx([1e-3, 0, 4e-3 - 0.4e-3])
    assert list(press.readings) == ["lower.fx", "lower.fz"] and press.readings["lower.fz"][2] == -0.3
    with pytest.raises(BadRecording, match=r"down to -0.0004 m; it is the gap between the gels, in metres"):
        Recordings(load_scene("squeeze")).read(tmp_path / "a.csv")
    (tmp_path / "gap.csv").write_text(GAPS)
    squeeze = Recordings(load_scene("squeeze")).read(tmp_path / "gap.csv")
    assert squeeze.poses["upper"][0].quaternion == pytest.approx(HALF_TURN_X.quaternion)


def test_a_table_of_another_ball(tmp_path: Path) -> None:
    """Its z is the height of that ball's lowest point."""
    (tmp_path / "big.csv").write_text(TABLE)
    press = Recordings(load_scene("press"), balls={"big": 6e-3}).read(tmp_path / "big.csv")
    assert press.ball == 6e-3 and press.poses["indenter"][2].position == pytest.approx([1e-3, 0, 6e-3 - 0.4e-3])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y,z\n0,0,0\n0,0,0\n0,0,0\n", "no forces"),
        ("x,y,fz\n0,0,0\n", "no column 'z'"),
        ("x,y,z,fz\n0,0,0,nan\n", "'nan' is not a finite number"),
        ("x,y,z,fz\n0,0,0,1\n0,0,0,1\n", "2 moments"),
        (TABLE.replace("\n2,", "\n0.5,"), "goes back"),
        ("", "no column 'x'"),
        (
            "x,y,z,fz\n0,0,0,0\n0,0,-0.1,-1\n0,0,-0.3,-2\n",
            "down to -0.3 m, through the gel of 0.004 m",
        ),
    ],
)
def test_a_table_that_will_not_do_says_why(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises((BadRecording, EpisodeError), match=message):
        Recordings(load_scene("press")).read(tmp_path / "a.csv")


def test_sources_that_are_no_recordings(tmp_path: Path) -> None:
    (tmp_path / "note.txt").write_text("no")
    for source, message in (
        (tmp_path, "no recordings"), (tmp_path / "gone", "no such"), (tmp_path / "note.txt", "allowed: .csv")
    ):  # fmt: skip
        with pytest.raises(BadRecording, match=message):
            find_recordings([source])


@pytest.mark.parametrize("kind", ["press", "squeeze"])
def test_motions_are_policies(kind: str, tmp_path: Path) -> None:
    """Each that is named to tell something is there, and its arm goes back first, then forward."""
    scene = load_scene(kind)
    tables = motions(scene)
    assert set(MOTIONS_FOR_PARAMETER["gel" if kind == "press" else "body"].values()) <= set(tables) <= set(MOTION_TEXTS)
    for name, table in tables.items():
        path = tmp_path / f"{name}.csv"
        path.write_text(table)
        spec = RigSpec({}, ("lower", "upper"), False, 0.1)
        policy = load_policy(str(path), None, spec)
        arm = "lower" if kind == "press" else "upper"
        assert policy.needs.arms == {arm}
        policy.reset()
        start = Pose(np.array([1.0, 2.0, 3.0]), HALF_TURN_X.quaternion)
        seen = Observation({}, {arm: ArmState(start, np.zeros(6), np.zeros(6), None, 0.0)}, 0.0)
        targets = [policy(seen).tool[arm] for _ in table.splitlines()]
        assert targets[0].position[2] > 3.0 and min(each.position[2] for each in targets) < 3.0 - 0.7e-3
        steps = np.linalg.norm(np.diff([each.position for each in targets], axis=0), axis=1)
        assert steps.max() < 2e-3  # what an arm goes in a period


@pytest.mark.parametrize(
    ("text", "message"),
    [("z\n1\n", "columns are ARM.AXIS"), ("a.w\n1\n", "found 'a.w'"), ("a.z\nx\n", "not a finite"), ("", "found none")],
)
def test_a_script_that_is_none_says_why(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(PolicyNotFound, match=message):
        load_policy(str(tmp_path / "a.csv"), None, RigSpec({}, (), False, 0.1))


@pytest.fixture
def identified(tmp_path: Path) -> Identified:
    """A body's fit to a linear law: no simulation."""
    (tmp_path / "a.csv").write_text(GAPS)
    scene = load_scene("squeeze", ["preset=learn"])
    press = Recordings(scene).read(tmp_path / "a.csv")
    noise, parameters = Noise(1e-4), parameters_of("body", scene)
    signals = signals_of([press], noise)
    slopes = np.random.default_rng(1).normal(size=(len(signals.values), len(parameters)))

    def predict(points: list[Point]) -> list[np.ndarray]:
        begun = np.array([each.free(each.start) for each in parameters])
        return [signals.values + slopes @ (point.free - begun - 0.01) for point in points]

    fit = estimate_materials([predict], signals, parameters, Priors(1e-6, 1e-6), coarse_error=0.0)
    found = scene_with(scene, {each.name: fit.value(each.name) for each in fit.identified})
    return Identified("body", found, fit, (press,), signals, (), noise, fit)


def test_the_files_are_taken_by_other_commands(
    identified: Identified, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "new" / "clay"
    names = [path.name for path in results.write(folder, identified)]
    assert names == ["identified.json", "identified.png", "material.yaml", "scene.yaml"]
    config = load_rig("sim", overrides=["scene.body.material=new/clay/material.yaml"]).config
    stiffness = identified.fit.value("youngs_modulus")
    assert config.scene.body.material.youngs_modulus == pytest.approx(stiffness, rel=1e-5)
    assert stiffness == pytest.approx(0.5e6 * np.exp(0.01), rel=1e-3)
    config = load_rig("sim", overrides=["scene=new/clay/scene.yaml"]).config
    assert config.scene.friction["upper"] == pytest.approx(identified.fit.value("friction_upper"))
    assert "# 5" in (folder / "material.yaml").read_text()  # an interval


def test_what_speaks_against_a_fit_leaves_no_material(identified: Identified, tmp_path: Path) -> None:
    from dataclasses import replace

    doubted = replace(identified, findings=(Finding("drift", "the zero drifts", 0.0),))
    names = [path.name for path in results.write(tmp_path / "clay", doubted)]
    assert names == ["identified.json", "identified.png"]


def test_a_write_that_fails_leaves_nothing(
    identified: Identified, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(results, "draw", full)
    with pytest.raises(OSError, match="No space"):
        results.write(tmp_path / "new" / "clay", identified)
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]


def test_a_coarser_force_sensor_tells_less(identified: Identified) -> None:
    now, worse = predict_intervals(identified, 1e-4), predict_intervals(identified, 1e-2)
    assert all(worse[name] > 2 * now[name] for name in now)

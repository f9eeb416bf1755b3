"""A learned policy says when it observes what it did not observe in training, and does not pass where it cannot."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import helper

from robot.deploy.control_loop import EpisodeSetup, run_episode
from robot.deploy.onnx_policy import OnnxPolicy
from robot.deploy.policy import has_training_range, load_policy, training_notes
from robot.deploy.training_range import RangeMonitor, describe_scenes_outside, extract_numbers, fit_training_range
from robot.open import open_rig
from robot.train.evaluate import evaluate
from robot.train.measure_range import measure_range, write_range
from tacsim.config import load_rig, load_scene
from tacsim.models.scene import Scene
from tacsim.models.task import SqueezeConfig
from tacsim.report.report import summarise
from tacsim.report.series import Series
from tacsim.tasks import make_task
from tests.robot.cli.invoked import tacsim
from tests.robot.deploy.test_onnx_policy import FEATURES, GRID, graph, spec
from tests.robot.train.short import training
from tests.tacsim.gym.small import SMALL

SCENE = "scene.body.material"


def pressed(stiffness: float, random: np.random.Generator) -> np.ndarray[Any, Any]:
    """(30, 2) the gap of two sensors that close on a body, and how deep it goes into them: by its stiffness."""
    closing = np.linspace(0, 1, 30) * random.uniform(0.5, 1.0)
    return np.stack([1 - closing, stiffness * closing + random.normal(0, 0.005, 30)], axis=1)


def share_outside(known: Any, episodes: list[np.ndarray[Any, Any]]) -> float:
    watch, count = RangeMonitor(known), 0
    for episode in episodes:
        watch.reset()
        for numbers in episode:
            watch({"touch": numbers})
        count += watch.is_outside
    return count / len(episodes)


def test_range_monitor_stiffer_body_is_outside() -> None:
    """3 of 100 episodes of training are beyond the limit, give or take what 100 episodes of calibration leave open."""
    random = np.random.default_rng(3)
    known = fit_training_range([pressed(random.uniform(0.2, 0.8), random) for _ in range(200)], [])
    assert share_outside(known, [pressed(random.uniform(0.2, 0.8), random) for _ in range(300)]) <= 0.08
    stiff = [pressed(random.uniform(1.2, 1.6), random) for _ in range(50)]
    assert share_outside(known, stiff) >= 0.95
    # no deeper than training was, but too early: it is the combination that is new
    early = [each[each[:, 1] <= 0.8] for each in stiff]
    assert max(each[:, 1].max() for each in early) <= max(known.high)
    assert share_outside(known, early) >= 0.6


def test_range_monitor_names_number_farthest_outside() -> None:
    random = np.random.default_rng(4)
    known = fit_training_range([random.uniform(0, 1, (20, 2)) for _ in range(40)], [])
    watch = RangeMonitor(known, ["gap", "depth"])
    watch({"touch": np.array([0.5, 0.5])})
    assert not watch.is_outside
    watch({"touch": np.array([0.5, 9.0])})
    assert watch.is_outside
    assert "depth is 9, in training 0" in watch.describe_outside()
    watch.reset()
    assert not watch.is_outside


def test_extract_numbers_map_gives_mean_minimum_maximum() -> None:
    maps = np.arange(8.0).reshape(2, 2, 2)
    assert extract_numbers({"maps": maps, "goal": np.array([7.0])}, 1).tolist() == [7.0, 1.5, 0.0, 3.0, 5.5, 4.0, 7.0]


def test_extract_numbers_uses_newest_frame() -> None:
    seen = {"touch": np.array([1.0, 2.0, 3.0, 4.0]), "goal": np.array([5.0, 6.0])}
    assert extract_numbers(seen, 2).tolist() == [5.0, 6.0, 3.0, 4.0]


def scene(*overrides: str) -> Scene:
    found = load_rig("sim", task="squeeze", overrides=overrides).config.scene
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("override", "said"),
    [
        (f"{SCENE}.yield_stress=60 kPa", "body.material.yield_stress is 60000, in training 5000 to 20000"),
        ("scene.friction={lower: 0.1, upper: 0.6}", "friction.lower is 0.1, in training 0.6"),
        ("scene.gel.material.youngs_modulus=0.3 MPa", "gel.material.youngs_modulus is 300000, in training"),
        ("scene.body.geometry.size=[20 mm, 10 mm, 10 mm]", r"body.geometry.size\[0\] is 0.02, in training 0.01"),
        ("scene.body.geometry={shape: sphere, radius: 5 mm}", "body.geometry.shape is sphere, in training box"),
        (f"{SCENE}={{youngs_modulus: 0.5 MPa}}", "body.material.yield_stress is not given, in training 5000 to 20000"),
        ("scene.gravity=[0, 0, -9.81]", r"gravity\[2\] is -9.81, in training 0"),
    ],
)
def test_describe_scenes_outside_names_parameter(override: str, said: str) -> None:
    import re

    met = [scene(f"{SCENE}.yield_stress={each}") for each in ("5 kPa", "20 kPa")]
    known = fit_training_range([np.random.default_rng(0).normal(size=(9, 2)) for _ in range(4)], met)
    assert describe_scenes_outside(known, [scene(f"{SCENE}.yield_stress=12 kPa", "scene.preset=learn")]) == []
    assert any(re.match(said, each) for each in describe_scenes_outside(known, [scene(override)]))


def test_describe_scenes_outside_names_mass_and_friction_of_a_held_object() -> None:
    trained = [load_scene("hold", [f"object.mass={mass}", "object.friction=0.5"]) for mass in (0.05, 0.2)]
    known = fit_training_range([np.random.default_rng(0).normal(size=(9, 2)) for _ in range(4)], trained)
    within = load_scene("hold", ["object.mass=0.1", "object.friction=0.5", "object.position=[3 mm, 0 mm]"])
    assert describe_scenes_outside(known, [within]) == []
    outside = load_scene("hold", ["object.mass=0.3", "object.friction=0.2"])
    assert describe_scenes_outside(known, [outside]) == [
        "object.mass is 0.3, in training 0.05 to 0.2",
        "object.friction is 0.2, in training 0.5",
    ]


def written(path: Path, **changed: Any) -> Path:
    model: onnx.ModelProto = graph()
    helper.set_model_props(model, {"tacsim.spec": json.dumps(spec(**changed))})
    path.write_bytes(model.SerializeToString())
    return path


@pytest.fixture(scope="module")
def ranged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy with the range of its training, measured by the shipped command's functions."""
    path = tmp_path_factory.mktemp("policies") / "policy.onnx"
    settings = training(features=FEATURES.model_dump(mode="json"))
    written(path, trained={"training": settings.model_dump(mode="json")})
    write_range(path, path, measure_range(path, episodes=24))
    return path


@pytest.mark.slow
def test_measure_range_is_written_to_policy_file(ranged: Path) -> None:
    policy = OnnxPolicy(ranged, GRID, 2e-3)
    known = policy.range_monitor.known
    assert known is not None
    assert known.episodes == 24
    assert known.scene["body.material.yield_stress"] == pytest.approx((5e3, 20e3))
    within = [scene(*SMALL, f"{SCENE}.yield_stress=12 kPa")]
    assert training_notes(policy, "p", within) == []
    (said,) = training_notes(policy, "p", [scene(*SMALL, f"{SCENE}.yield_stress=70 kPa")])
    assert "body.material.yield_stress is 70000" in said


def test_run_records_training_distance_and_summary(ranged: Path) -> None:
    shares = {}
    for yield_stress, steps in (("12 kPa", 3), ("400 kPa", 3)):
        overrides = [*SMALL, f"{SCENE}.yield_stress={yield_stress}", "motion=settled"]
        with open_rig("sim", task="squeeze", overrides=overrides) as rig:
            task = make_task(SqueezeConfig(kind="squeeze", goal=2e-3 if yield_stress == "12 kPa" else 0.5e-3))
            policy = load_policy(str(ranged), task, rig.spec, GRID)
            episode = run_episode(rig, policy, task, steps, setup=EpisodeSetup(seed=1))
        assert all("training_distance" in step.info for step in episode.steps[1:])
        shares[yield_stress] = summarise(Series.from_episode(episode))["training_range"]
    assert shares["12 kPa"]["known"] is True
    assert shares["400 kPa"]["largest"] > 1.0
    assert shares["400 kPa"]["steps_outside"] == 3  # a goal that training never had


@pytest.mark.slow
def test_run_policy_without_range_is_reported_once(tmp_path: Path) -> None:
    path = written(tmp_path / "bare.onnx")
    assert not has_training_range(OnnxPolicy(path, GRID, 2e-3))
    words = [word for override in SMALL for word in ("--set", override)]
    result = tacsim("run", "sim", "--policy", str(path), "--steps", "2", "--out", str(tmp_path / "out"), *words)
    assert result.exit_code == 0, result.output
    assert result.stderr.count("unknown training range") == 1
    stats = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert stats["training_range"]["known"] is False
    assert "training range" in result.stdout


def test_evaluate_reports_scenes_outside_and_counts_episodes(ranged: Path) -> None:
    values = {"scene.body.material.yield_stress": {"uniform": ["60 kPa", "80 kPa"]}}
    outside = training(features=FEATURES.model_dump(mode="json"), randomise={"draws": 3, "values": values})
    said: list[str] = []
    judged = evaluate(outside, [str(ranged), "teacher"], 3, warn=said.append)
    assert len(said) == 1
    assert "body.material.yield_stress is 6" in said[0] and "in training 5000 to 20000" in said[0]
    assert judged[0].outside is not None
    assert judged[1].outside is None

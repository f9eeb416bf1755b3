"""The learned policies that come with tacsim."""

from __future__ import annotations

from pathlib import Path

import pytest

from robot.deploy.control_loop import EpisodeSetup, run_episode
from robot.deploy.policy import PolicyNotFound, describe_outside, load_policy, require_fit, training_notes
from robot.open import open_rig
from tacsim.config import config_root, load_model, load_rig
from tacsim.models.policy import Training
from tacsim.tasks import make_task

SHIPPED = sorted((config_root() / "policies").glob("*.onnx"))
# fraction of the initial distance
MIN_IMPROVEMENT = {
    "squeeze": 0.95, "reposition": 0.95, "knead": 0.1, "hold": 0.95, "turn": 0.9, "drawer": 0.95, "peg": 0.9,
}  # fmt: skip
# What makes the task's own scene as hard as others: a hole that is aside
CHANGES = {"peg": ("scene.fixtures.hole.position=[0.5 mm, 1.5 mm, 20 mm]",)}


@pytest.mark.slow
@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_policy_solves_its_task(path: Path) -> None:
    """On the task's own body and goal, in the physics that it was trained in."""
    training = load_model(Training, path.stem)
    loaded = load_rig(training.rig, task=training.task, overrides=[*training.overrides, *CHANGES.get(path.stem, ())])
    assert loaded.config.task is not None
    task = make_task(loaded.config.task)
    steps = min(task.config.steps, 80)
    with open_rig(loaded) as rig:
        policy = load_policy("learned", task, rig.spec, loaded.config.canonical)
        require_fit(rig.name, rig.spec, policy, "learned", task)
        episode = run_episode(rig, policy, task, steps, setup=EpisodeSetup(seed=1))
    first, last = (episode.steps[at].distance for at in (0, -1))
    assert first is not None and last is not None
    assert last < (1 - MIN_IMPROVEMENT[path.stem]) * first


@pytest.mark.parametrize(("yield_stress", "outside"), [("20 kPa", False), ("70 kPa", True)])
def test_shipped_squeeze_stiff_body_is_outside_training(yield_stress: str, outside: bool) -> None:
    """By its observations, and by the parameter of the scene."""
    training = load_model(Training, "squeeze")
    overrides = [*training.overrides, f"scene.body.material.yield_stress={yield_stress}"]
    loaded = load_rig(training.rig, task=training.task, overrides=overrides)
    assert loaded.config.task is not None and loaded.config.scene is not None
    task = make_task(loaded.config.task)
    with open_rig(loaded) as rig:
        policy = load_policy("learned", task, rig.spec, loaded.config.canonical)
        episode = run_episode(rig, policy, task, task.config.steps, setup=EpisodeSetup(seed=1))
    distances = [step.info["training_distance"] for step in episode.steps[1:]]
    assert (max(distances) > 1.0) == outside
    assert bool(describe_outside(policy)) == outside
    said = training_notes(policy, "learned", [loaded.config.scene])
    assert any("body.material.yield_stress is 70000, in training 4000 to 40000" in each for each in said) == outside


def test_shipped_policies_are_small() -> None:
    assert SHIPPED
    assert sum(path.stat().st_size for path in SHIPPED) < 5e6
    assert max(path.stat().st_size for path in SHIPPED) < 2e6


def test_load_policy_learned_without_file_lists_tasks() -> None:
    with open_rig("sim") as rig, pytest.raises(PolicyNotFound, match=r"this rig has no task; there are: .*squeeze"):
        load_policy("learned", None, rig.spec)

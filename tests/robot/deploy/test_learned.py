"""The learned policies that come with tacsim."""

from __future__ import annotations

from pathlib import Path

import pytest

from robot.deploy.control_loop import EpisodeSetup, run_episode
from robot.deploy.policy import PolicyNotFound, load_policy, require_fit
from robot.open import open_rig
from tacsim.config import config_root, load, load_rig
from tacsim.models.training import Training
from tacsim.tasks import make_task

SHIPPED = sorted((config_root() / "policies").glob("*.onnx"))
LEAST = {"squeeze": 0.95, "reposition": 0.95, "knead": 0.1}  # share of the distance that must be gone


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_each_runs_and_does_its_task(path: Path) -> None:
    """On the task's own body and goal, in the physics that it was trained in."""
    training = load(Training, path.stem)
    loaded = load_rig(training.rig, task=training.task, overrides=training.overrides)
    assert loaded.config.task is not None
    task = make_task(loaded.config.task)
    steps = min(task.config.steps, 80)
    with open_rig(loaded) as rig:
        policy = load_policy("learned", task, rig.spec, loaded.config.canonical)
        require_fit(rig.name, rig.spec, policy, "learned", task)
        episode = run_episode(rig, policy, task, steps, setup=EpisodeSetup(seed=1))
    first, last = (episode.steps[at].distance for at in (0, -1))
    assert first is not None and last is not None
    assert last < (1 - LEAST[path.stem]) * first


def test_they_are_small() -> None:
    assert SHIPPED
    assert sum(path.stat().st_size for path in SHIPPED) < 5e6
    assert max(path.stat().st_size for path in SHIPPED) < 2e6


def test_a_task_without_one_says_which_there_are() -> None:
    with open_rig("sim") as rig, pytest.raises(PolicyNotFound, match=r"this rig has no task; there are: .*squeeze"):
        load_policy("learned", None, rig.spec)

"""What a person may ask of a task in error: goals out of reach, forces that a reset exceeds, draws that cannot be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot.deploy.control_loop import EpisodeFailed, run_episode
from robot.deploy.python_policy import FunctionPolicy
from robot.open import make_env, open_rig
from tacsim.config import ConfigError, load_rig
from tacsim.interface import Truth
from tacsim.limits import ActionError
from tacsim.models.task import KneadConfig, RepositionConfig, SqueezeConfig
from tacsim.pose import Pose
from tacsim.tasks import GoalOutOfReach, make_task
from tests.robot.cli.invoked import TINY, tacsim
from tests.tacsim.gym.small import SMALL, make, make_native

START = Truth(10e-3, np.array([1e-3, 0.0, 5e-3]), np.zeros((1, 3), np.float32), {"lower": Pose(), "upper": Pose()})


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (SqueezeConfig(kind="squeeze", goal=11e-3), "11 mm is above the body, which is 10 mm high"),
        (
            RepositionConfig(kind="reposition", goal=(9.1e-3, 0)),
            r"leave the gel of sensor 'lower' if it moved by \(9.1, 0",
        ),
        (RepositionConfig(kind="reposition", goal=(0, -10.1e-3)), "give a nearer goal"),
        (KneadConfig(kind="knead", slenderness=10), "the rod would be 50.3 mm long along x, the gels are 20 mm"),
    ],
)
def test_a_goal_that_nobody_can_reach_is_told(config: Any, words: str) -> None:
    with pytest.raises(GoalOutOfReach, match=words):
        make_task(config).require_reachable(START)


@pytest.mark.parametrize(
    "config",
    [
        SqueezeConfig(kind="squeeze", goal=10.05e-3),  # within success
        RepositionConfig(kind="reposition", goal=(8.9e-3, -9.9e-3)),
        KneadConfig(kind="knead"),
    ],
)
def test_goals_at_the_edge_are_allowed(config: Any) -> None:
    make_task(config).require_reachable(START)


def test_a_run_ends_at_the_reset(open_springs: Any) -> None:
    rig, task = open_springs(), make_task(SqueezeConfig(kind="squeeze", goal=12e-3))
    with pytest.raises(GoalOutOfReach):
        run_episode(rig, task.scripted(), task, 3)


def test_the_command_tells_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = tacsim("run", "--set", "task.goal=40 mm", "--out", "r", *TINY)
    assert result.exit_code == 2
    assert "above the body" in result.stderr and "give a lower goal" in result.stderr
    assert not (tmp_path / "r").exists()


def test_a_force_that_the_reset_itself_exceeds_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"force_limit 0.04 N: a reset presses by touch_force, 0.05 N; give more"):
        load_rig("sim", overrides=["task.force_limit=0.04 N"])
    limits = "{workspace: {lower: [-40mm, -40mm, -40mm], upper: [40mm, 40mm, 60mm]}, force: 0.5 N}"
    overrides = [f"arms.upper.limits={limits}"]
    load_rig("sim", task="squeeze", overrides=overrides)
    with pytest.raises(ConfigError, match=r"arm 'upper' stops at 0.5 N, and a reset presses by task.touch_force, 1 N"):
        load_rig("sim", task="reposition", overrides=overrides)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            {"scene.friction.upper": {"uniform": [6, 9]}},
            r"scene.friction.upper: .* out of range.*\nvariant 0: scene.fr",
        ),
        (
            {"scene.body.material.yield_stress": {"choice": [0.001]}},
            r"yields at so small a stress.*\nvariant 0: scene.body",
        ),
        ({"task.goul": {"choice": [1]}}, r"task.goul: unknown key.*did you mean 'goal'"),
        ({"task.steps": {"uniform": [2, 5]}}, r"task.steps: .*a whole number"),
    ],
)
def test_draws_that_cannot_be_are_told_with_what_was_drawn(values: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make_env(overrides=SMALL, randomise={"draws": 2, "values": values})


@pytest.mark.parametrize(
    "action", [np.array([np.nan, 0]), np.zeros(3), np.zeros((1, 2)), None, "ab", np.array([2.0, 0]), np.array([1j, 0])]
)
def test_an_environment_goes_on_after_an_action_that_is_none(action: Any) -> None:
    env = make(variants=())
    env.reset(seed=1)
    before = env.rig.observe().arms["lower"].pose.position[2]
    with pytest.raises(ActionError):
        env.step(action)
    assert env.rig.observe().arms["lower"].pose.position[2] == before
    env.step(np.zeros(2, np.float32))


def test_one_bad_action_of_a_batch_moves_none_of_it() -> None:
    envs = make_native(3, variants=())
    envs.reset(seed=1)
    places = [env.rig.observe().arms["lower"].pose.position[2] for env in envs.members]
    bad = np.ones((3, 2), np.float32)
    bad[1, 0] = np.nan
    with pytest.raises(ActionError, match="must be finite"):
        envs.step(bad)
    envs.step(np.zeros((3, 2), np.float32))
    assert [env.rig.observe().arms["lower"].pose.position[2] for env in envs.members] == places
    envs.close()


class Slow:
    """Returns something that is not an action, the second time."""

    def __init__(self, wrong: Any) -> None:
        self._wrong, self._count = wrong, 0

    def __call__(self, observation: Any) -> Any:
        self._count += 1
        return make_task(SqueezeConfig(kind="squeeze")).scripted()(observation) if self._count == 1 else self._wrong


@pytest.mark.parametrize("wrong", [None, np.zeros(2), {"upper": None}, 3.0])
def test_what_a_policy_gives_instead_of_an_action_ends_the_episode_with_all_steps_kept(wrong: Any) -> None:
    said = r"after 1 of 5 steps: ActionError: rig 'sim' takes a tacsim.Action|action for"
    with (
        open_rig("sim", task="squeeze", overrides=SMALL) as rig,
        pytest.raises(EpisodeFailed, match=said) as failed,
    ):
        run_episode(rig, FunctionPolicy(Slow(wrong)), None, 5)
    assert len(failed.value.episode.steps) == 2

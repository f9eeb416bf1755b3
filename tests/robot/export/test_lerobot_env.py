"""A task through LeRobot's eyes, without LeRobot: the numbers of a data set in, the numbers of a data set out."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from robot.export.lerobot_env import LeRobotEnv
from tacsim.gym.features import SCALES
from tacsim.limits import ActionError
from tests.tacsim.gym.small import SMALL, make


@pytest.fixture(scope="module")
def env() -> Iterator[LeRobotEnv]:
    made = LeRobotEnv("squeeze", "sim", SMALL, render_mode="rgb_array")
    yield made
    made.close()


def test_an_episode_is_that_of_the_task(env: LeRobotEnv) -> None:
    """The same motion, asked for as poses and as components of the task's own action, is the same to the last bit."""
    other: Any = make(variants=())
    _, wanted = other.reset(seed=7)
    seen, info = env.reset(seed=7, options={"lerobot_new_rollout": True})
    assert env.observation_space.contains(seen) and info == wanted and info["is_success"] is False
    names = list(env._mapping.action.names)
    lower, upper = (names.index(f"moved_z_{arm}.pos") for arm in ("lower", "upper"))
    assert (env._max_episode_steps, env.task, env.metadata["render_fps"]) == (3, "squeeze", 10)
    assert env.task_description == "squeeze the body to a height of 2 mm"
    step = other.task.config.max_step
    for k in range(1, 4):
        flat, reward, *ends, wanted = other.step(np.array([0.5, -0.5], np.float32))
        action = np.zeros(env.action_space.shape, np.float32)  # type: ignore[arg-type]
        # Both arms go along their own z, which is towards the body: the upper one faces down.
        action[[lower, upper]] = 0.5 * k * step / SCALES["moved"]
        seen, found, *ended, info = env.step(action)
        assert ended == ends and ended == [False, k == 3]
        assert found == pytest.approx(reward, rel=1e-4) and info["is_success"] == wanted["is_success"]
        picture = seen["pixels"]["upper"]
        assert np.abs(picture.astype(int) - flat["tactile_upper"]).max() <= 1
        assert env.observation_space.contains(seen)
    frame = env.render()
    assert frame is not None and frame.shape[2] == 3


def test_no_action_is_refused(env: LeRobotEnv) -> None:
    env.reset(seed=0)
    with pytest.raises(ActionError, match=r"shape \(18,\), got \(2,\)"):
        env.step(np.zeros(2, np.float32))
    with pytest.raises(ActionError, match="is no pose"):
        env.step(np.full(18, np.nan, np.float32))

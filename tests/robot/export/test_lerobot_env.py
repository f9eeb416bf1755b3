"""A task through LeRobot's eyes, without LeRobot: the numbers of a data set in, the numbers of a data set out."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from robot.export.lerobot_env import LeRobotEnv
from tacsim.gym.features import SCALES
from tacsim.interface import Action, GripperTarget
from tacsim.limits import ActionError
from tests.tacsim.gym.small import SMALL, make

HAND = (  # small pictures
    *("scene.preset=learn", "motion=flowing"),
    *(
        f"sensors.{name}.model.geometry.{key}"
        for name in ("left", "right")
        for key in ("width=16", "height=16", "pixel_pitch=1 mm")
    ),
)


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


def test_the_goal_is_in_the_state_and_what_is_no_pose_is_of_the_environment(env: LeRobotEnv) -> None:
    """Without it no policy of LeRobot could know the goal."""
    seen, _ = env.reset(seed=7)
    names = env._mapping.state.names
    assert names[-1] == "goal_0.vel" and seen["agent_pos"][-1] * SCALES["goal"] == pytest.approx(2e-3)
    chosen = [name.endswith(".vel") for name in names]
    assert np.array_equal(seen["environment_state"], seen["agent_pos"][chosen])
    assert seen["environment_state"].shape == (26,) and "moved_z_lower.pos" not in env._mapping.environment


@pytest.mark.slow
def test_an_action_has_width_and_force_of_a_gripper() -> None:
    """Of the hand: what a data set holds of the teacher's grip is what the environment sends."""
    pytest.importorskip("mujoco")
    made = LeRobotEnv("hold", "hand", HAND)
    seen, _ = made.reset(seed=3)
    names = list(made._mapping.action.names)
    assert names[-2:] == ["width_hand.pos", "grip_force_hand.pos"] and len(names) == 11
    state = dict(zip(made._mapping.state.names, seen["agent_pos"], strict=True))
    rig = made._env.rig
    held = rig.observe().grippers["hand"]
    assert state["width_hand.pos"] * SCALES["width"] == pytest.approx(held.width, rel=1e-3)
    asked = Action(grippers={"hand": GripperTarget(0.0, 2.5)})
    numbers = made._mapping.encode_action(asked)
    assert numbers[-1] * SCALES["force"] == pytest.approx(2.5)
    again = made._mapping.decode_action(numbers).grippers["hand"]
    assert again is not None and (again.width, again.force) == (0.0, pytest.approx(2.5))
    made.step(numbers)
    sent = rig.sent_grippers["hand"]
    assert sent is not None and sent.force == pytest.approx(2.5, rel=1e-3)
    lower = made._mapping.decode_action(numbers - np.float32(0.01)).grippers["hand"]
    assert lower is not None and lower.width == 0.0
    with pytest.raises(ActionError, match="is no width and force"):
        made.step(np.append(numbers[:-1], np.float32(np.nan)))
    made.close()

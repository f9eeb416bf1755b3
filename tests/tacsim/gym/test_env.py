"""The environment keeps Gymnasium's contract. (That gymnasium.make finds it is tested with robot.open.)"""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from tacsim.gym import ENVIRONMENTS, register_envs
from tacsim.gym.env import TacsimEnv
from tacsim.interface import IncompatibleRig
from tacsim.limits import ActionError
from tacsim.models.task import RepositionConfig, SqueezeConfig
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.tasks import Task, make_task

STILL = np.zeros(2, np.float32)


def make_env(open_springs: Any, task: str = "squeeze", steps: int = 5) -> TacsimEnv:
    config = {
        "squeeze": SqueezeConfig(kind="squeeze", steps=steps),
        "reposition": RepositionConfig(kind="reposition", steps=steps),
    }
    return TacsimEnv(open_springs(task), make_task(config[task]), render_mode="rgb_array")


@pytest.mark.parametrize("task", ["squeeze", "reposition"])
def test_check_env_is_content_without_a_warning(open_springs: Any, task: str) -> None:
    env = make_env(open_springs, task)
    env.spec = None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=True)


@pytest.mark.parametrize(("task", "moved"), [("squeeze", ("lower", "upper")), ("reposition", ("upper",))])
def test_actions_move_the_free_axes_by_max_step(open_springs: Any, task: str, moved: tuple[str, ...]) -> None:
    env = make_env(open_springs, task)
    env.reset(seed=0)
    before = {name: env.rig.observe().arms[name].pose.position for name in ("lower", "upper")}
    flat, *_ = env.step(np.array([1.0, -0.5], np.float32))
    after = {name: env.rig.observe().arms[name].pose.position for name in ("lower", "upper")}
    change = {name: after[name] - before[name] for name in before}
    if task == "squeeze":
        expected = {"lower": [0, 0, 0.2e-3], "upper": [0, 0, -0.1e-3]}
    else:
        expected = {"lower": [0, 0, 0], "upper": [0.2e-3, -0.1e-3, 0]}
    for name, want in expected.items():
        assert change[name] == pytest.approx(want, abs=1e-12)
    env.step(np.array([1.0, -0.5], np.float32))  # goes on from where the arms were sent
    twice = {name: env.rig.observe().arms[name].pose.position - before[name] for name in before}
    for name, want in expected.items():
        assert twice[name] == pytest.approx(2 * np.array(want), abs=1e-12)
    # the pose in the observation is relative to reset, in the sensor's own axes: the upper one is half-turned about x
    sign = np.array([1, -1, -1])
    assert flat["pose_upper"][:3] == pytest.approx(sign * expected["upper"], abs=1e-9)


def test_reward_and_info_come_from_the_truth(open_springs: Any) -> None:
    env = make_env(open_springs)
    _, info = env.reset(seed=0)
    assert info["distance"] == pytest.approx(3e-3, rel=0.01)
    truth = env.rig.truth()
    assert truth is not None
    assert info["body_height"] == truth.height
    _, reward, terminated, truncated, info = env.step(np.array([1.0, -1.0], np.float32))
    truth = env.rig.truth()
    assert truth is not None
    assert info["distance"] == abs(truth.height - 7e-3)
    assert reward == pytest.approx(-info["distance"] / 1e-3)
    assert not terminated
    assert not truncated
    assert info["is_success"] is False
    assert 0 < info["score"] < 0.1


def test_an_episode_is_truncated_after_its_steps(open_springs: Any) -> None:
    env = make_env(open_springs, steps=3)
    env.reset(seed=0)
    assert [env.step(STILL)[3] for _ in range(3)] == [False, False, True]
    env.reset(seed=0)
    assert env.step(STILL)[3] is False


def test_same_seed_same_episode(open_springs: Any) -> None:
    rig = open_springs("squeeze", "task.placement=1 mm")
    env = TacsimEnv(rig, make_task(SqueezeConfig(kind="squeeze")))

    def run(seed: int) -> tuple[dict[str, np.ndarray], list[float]]:
        env.reset(seed=seed)
        results = [env.step(np.array([0.5, -0.5], np.float32)) for _ in range(3)]
        return results[-1][0], [result[1] for result in results]

    (flat, rewards), (other_flat, other_rewards), (third_flat, _) = run(1), run(1), run(2)
    assert rewards == other_rewards
    assert all(np.array_equal(flat[key], other_flat[key]) for key in flat)
    assert not np.array_equal(flat["wrench_lower"], third_flat["wrench_lower"])


def test_a_bad_action_is_refused_not_clipped(open_springs: Any) -> None:
    env = make_env(open_springs)
    env.reset(seed=0)
    with pytest.raises(ActionError, match="ClipAction"):
        env.step(np.array([1.5, 0.0], np.float32))


def test_divergence_truncates_and_says_why(open_springs: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_env(open_springs)
    env.reset(seed=0)
    last = env.step(np.array([0.5, -0.5], np.float32))
    world = env.rig.world  # type: ignore[attr-defined]

    def diverge(*targets: Any, flow: bool = False) -> None:
        raise SimulationDiverged("NaN", "substep 3", "move less")

    monkeypatch.setattr(world, "move", diverge)
    flat, reward, terminated, truncated, info = env.step(np.array([0.5, -0.5], np.float32))
    assert truncated
    assert not terminated
    assert "NaN; substep 3" in info["diverged"]
    assert reward == last[1]
    assert all(np.array_equal(flat[key], last[0][key]) for key in flat)
    with pytest.raises(ResetNeeded):
        env.step(STILL)
    monkeypatch.undo()
    env.reset(seed=0)
    assert env.step(STILL)[3] is False


def test_too_much_force_fails_the_task_and_no_end_is_better_than_going_on(open_springs: Any) -> None:
    env = TacsimEnv(open_springs(), make_task(SqueezeConfig(kind="squeeze", steps=20, force_limit=1.0)))
    env.reset(seed=0)
    count = 0
    terminated = False
    while not terminated:
        count += 1
        flat, reward, terminated, truncated, info = env.step(np.array([1.0, -1.0], np.float32))
        if not terminated:
            assert info["peak_force"] <= 1.0 and "limit" not in info
            assert reward == pytest.approx(-info["distance"] / 1e-3)
    assert count < 20 and not truncated and info["peak_force"] > 1.0
    assert "beyond the task's force_limit of 1 N" in info["limit"] and info["is_success"] is False
    assert -flat["wrench_upper"][2] == pytest.approx(info["peak_force"])
    now = -info["distance"] / 1e-3
    assert reward == pytest.approx(now + (20 - count) * min(now, -1.0))
    with pytest.raises(ResetNeeded):
        env.step(STILL)


def test_a_limit_that_is_exceeded_ends_the_episode_and_says_which(open_springs: Any) -> None:
    box = "workspace: {lower: [-1 m, -1 m, -1 m], upper: [1 m, 1 m, 1 m]}"
    rig = open_springs("squeeze", f"arms.upper.limits={{{box}, force: 1 N}}")
    env = TacsimEnv(rig, make_task(SqueezeConfig(kind="squeeze", steps=100, success=5e-3)))
    env.reset(seed=0)
    for _ in range(60):
        _, reward, terminated, truncated, info = env.step(np.array([1.0, -1.0], np.float32))
        if terminated:
            break
        assert info["is_success"] is True
    assert terminated
    assert not truncated
    assert "limits.force" in info["limit"]
    assert info["is_success"] is False  # wherever it ended
    assert np.isfinite(reward)
    with pytest.raises(ResetNeeded):
        env.step(STILL)


def test_step_before_reset_is_refused(open_springs: Any) -> None:
    with pytest.raises(ResetNeeded):
        make_env(open_springs).step(STILL)


def test_render_shows_all_sensors_side_by_side(open_springs: Any) -> None:
    env = make_env(open_springs)
    env.reset(seed=0)
    picture = env.render()
    assert picture is not None
    assert picture.shape == (30, 80, 3)
    assert np.array_equal(picture[:, :40], env.rig.frames["lower"].image)
    assert np.array_equal(picture[:, 40:], env.rig.frames["upper"].image)


def test_a_rig_without_truth_is_refused(open_springs: Any) -> None:
    rig = open_springs()
    rig._truth = None
    rig.spec = type(rig.spec)(rig.spec.sensors, rig.spec.arms, False, rig.spec.period)
    with pytest.raises(IncompatibleRig, match="ground truth"):
        TacsimEnv(rig, make_task(SqueezeConfig(kind="squeeze")))


@pytest.mark.parametrize(
    ("options", "said"),
    [({"speed": 1}, "'speed'"), (5, "a dict, got 5"), ({"scene": 1}, "the scene is a tacsim Scene")],
)
def test_options_are_refused(options: Any, said: str, open_springs: Any) -> None:
    with pytest.raises(ValueError, match=said):
        make_env(open_springs).reset(options=options)


def test_environments_are_registered_once() -> None:
    register_envs()
    for name, task in ENVIRONMENTS.items():
        assert gymnasium.spec(name).kwargs == {"task": task}


def test_any_policy_acts_as_an_environment_s_action(open_springs: Any) -> None:
    """What it asks of the arms is where the step takes them, as float32 can say it."""
    from tacsim.tasks.task import action_of_vector

    env = TacsimEnv(open_springs("squeeze"), make_task(SqueezeConfig(kind="squeeze", goal=7e-3, steps=3)))
    env.reset(seed=3)
    policy = env.task.scripted()
    for _ in range(2):
        wanted = policy(env._observation).tool
        policy.reset()
        vector = env.policy_action(policy)
        policy.reset()
        asked = action_of_vector(vector, env.task.axes, env.task.config.max_step, env._targets).tool
        for arm, pose in wanted.items():
            now = asked[arm]
            assert pose is not None and now is not None
            assert np.abs(pose.position - now.position).max() < 1e-9
        env.step(vector)


def test_the_expert_is_the_tasks_by_the_truth_and_holds_where_nothing_runs(open_springs: Any) -> None:
    env = TacsimEnv(open_springs("squeeze"), make_task(SqueezeConfig(kind="squeeze", goal=7e-3, steps=3)))
    env.reset(seed=3)
    best = env.task.expert(env._require_truth(), env._truth_at_start)
    assert best is not None
    assert env.expert().tolist() == best.astype(np.float32).tolist()
    by_touch = env.policy_action(env.task.teacher())
    assert env.expert(knows_truth=False).tolist() == by_touch.tolist() != best.astype(np.float32).tolist()
    for _ in range(env.task.config.steps):
        env.step(env.expert())
    assert env.phase == "over"
    assert env.expert().tolist() == [0.0, 0.0]


def test_a_task_without_a_teacher_runs_all_the_same(open_springs: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    task = make_task(SqueezeConfig(kind="squeeze", goal=7e-3, steps=3))
    for what in ("expert", "scripted"):
        monkeypatch.setattr(type(task), what, getattr(Task, what))
    env = TacsimEnv(open_springs("squeeze"), task)
    env.reset(seed=3)
    env.step(np.zeros(2, np.float32))
    with pytest.raises(ValueError, match="task 'squeeze' has no scripted policy"):
        env.expert()

"""Scripted policies reach the goal by touch alone, on a world known in closed form."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from robot.deploy.control_loop import run_episode
from tacsim.interface import Action, Observation, Truth
from tacsim.models.sensor import CanonicalGrid
from tacsim.models.task import RepositionConfig, SqueezeConfig
from tacsim.tasks import make_task
from tacsim.tasks.reposition import centre_of_pressure, estimated_position
from tacsim.tasks.squeeze import Grip, estimated_height
from tacsim.tasks.task import action_of_vector

SQUEEZE = SqueezeConfig(kind="squeeze", goal=9.7e-3, max_step=0.2e-3)
REPOSITION = RepositionConfig(kind="reposition", goal=(2e-3, -1e-3), max_step=0.2e-3)


def test_squeeze_reaches_the_goal_then_holds(open_springs: Any) -> None:
    rig, task = open_springs(), make_task(SQUEEZE)
    episode = run_episode(rig, task.scripted(), task, 40)
    distances = [step.distance for step in episode.steps]
    assert len(distances) == 41
    assert min(distances) <= 0.02e-3
    assert distances[-1] == min(distances)
    last = episode.steps[-1].action
    assert last is not None
    assert set(last.tool.values()) == {None}


def test_squeeze_closes_alike_and_no_faster_than_half_of_max_step(open_springs: Any) -> None:
    task = make_task(SQUEEZE)
    episode = run_episode(open_springs(), task.scripted(through=True), task, 15)
    for before, after in zip(episode.steps, episode.steps[1:], strict=False):
        up = after.arms["lower"].pose.position - before.arms["lower"].pose.position
        down = after.arms["upper"].pose.position - before.arms["upper"].pose.position
        assert up == pytest.approx(-down, abs=1e-12)
        assert 0 < up[2] <= 0.1e-3 + 1e-12


def test_squeeze_shares_the_last_step_between_both_sensors(open_springs: Any) -> None:
    observation = open_springs().reset()
    config = SqueezeConfig(kind="squeeze", goal=estimated_height(observation) - 0.06e-3, max_step=0.2e-3)
    action = make_task(config).scripted()(observation)
    for name, way in (("lower", 0.03e-3), ("upper", -0.03e-3)):
        target = action.tool[name]
        assert target is not None
        assert target.position - observation.arms[name].pose.position == pytest.approx([0, 0, way], abs=1e-9)


def test_through_passes_the_goal_at_the_goal(open_springs: Any) -> None:
    """The reward rises to a peak at the goal, then falls for good, at the full rate."""
    config = SqueezeConfig(kind="squeeze", goal=9.7e-3, max_step=0.2e-3)
    rig, task = open_springs(), make_task(config)
    episode = run_episode(rig, task.scripted(through=True), task, 25)
    rewards = [step.reward for step in episode.steps]
    peak = int(np.argmax(rewards))
    assert 0 < peak < 15
    assert episode.steps[peak].distance <= 0.02e-3
    assert np.all(np.diff(rewards[peak:]) < 0)
    lower = [step.arms["lower"].pose.position[2] for step in episode.steps[peak:]]
    assert np.diff(lower) == pytest.approx(0.1e-3)


def test_estimated_height_is_the_true_height(open_springs: Any) -> None:
    rig = open_springs()
    observation = rig.reset()
    for _ in range(3):
        down = observation.arms["upper"].pose
        target = type(down)(down.position - [0, 0, 1e-4], down.quaternion)
        observation, _ = rig.step(Action({"upper": target}))
        assert estimated_height(observation) == pytest.approx(rig.truth().height, abs=2e-6)


def test_reposition_reaches_the_goal_although_the_body_lags(open_springs: Any) -> None:
    rig, task = open_springs("reposition"), make_task(REPOSITION)
    episode = run_episode(rig, task.scripted(), task, 40)
    distances = [step.distance for step in episode.steps]
    assert distances[0] == pytest.approx(np.hypot(2e-3, 1e-3), rel=0.01)
    assert min(distances) <= 0.03e-3
    assert distances[-1] == min(distances)
    sensor = episode.steps[-1].arms["upper"].pose.position[:2]
    assert np.hypot(*(sensor - REPOSITION.goal)) > 0.2e-3  # the sensor itself is beyond: the lag was felt


def test_reposition_through_goes_on_straight(open_springs: Any) -> None:
    rig, task = open_springs("reposition"), make_task(REPOSITION)
    episode = run_episode(rig, task.scripted(through=True), task, 40)
    rewards = [step.reward for step in episode.steps]
    peak = int(np.argmax(rewards))
    assert episode.steps[peak].distance <= 0.05e-3
    assert np.all(np.diff(rewards[peak:]) < 0)
    way = np.diff([step.arms["upper"].pose.position[:2] for step in episode.steps[peak:]], axis=0)
    assert way == pytest.approx(np.tile([0.1e-3, -0.05e-3], (len(way), 1)))


def test_reposition_feels_the_body_and_nothing_without_contact(open_springs: Any) -> None:
    rig = open_springs("reposition")
    observation = rig.reset()
    up = observation.arms["upper"].pose
    observation, _ = rig.step(Action({"upper": type(up)(up.position + [1e-3, -0.5e-3, 0], up.quaternion)}))
    assert estimated_position(observation) == pytest.approx(rig.truth().position[:2], abs=1e-9)
    free = replace(observation.arms["upper"], wrench=np.array([0.1, 0.0, -0.005, 1.0, 1.0, 1.0]))
    assert centre_of_pressure(free) is None
    task = make_task(REPOSITION)
    blind = Observation(observation.tactile, {**observation.arms, "upper": free}, 0.0)
    assert task.scripted()(blind).tool == {"upper": None}


def test_distances_are_felt_too_where_nobody_knows_the_truth(open_springs: Any) -> None:
    """Squeeze: to 2 um of the true distance; reposition: body and pressure are in one place here."""
    for name, config, way in (("squeeze", SQUEEZE, 2e-6), ("reposition", REPOSITION, 1e-9)):
        rig, task = open_springs(name), make_task(config)
        episode = run_episode(rig, task.scripted(), task, 10)
        for step in episode.steps[1:]:
            assert step.info["felt_distance"] == pytest.approx(step.distance, abs=way)
        rig._truth, rig.spec = None, replace(rig.spec, truth=False)
        blind = run_episode(rig, task.scripted(), task, 10)
        assert [step.distance for step in blind.steps] == [None] * 11
        felt, same = ([step.info["felt_distance"] for step in each.steps[1:]] for each in (blind, episode))
        assert felt == same


@pytest.mark.parametrize("config", [SQUEEZE, REPOSITION])
def test_nothing_is_felt_without_touch(config: Any, open_springs: Any) -> None:
    rig, task = open_springs(config.kind), make_task(config)
    rig.reset()
    up = rig.observe().arms["upper"].pose
    feel = task.estimator(CanonicalGrid())
    touching, _ = rig.step(Action({"upper": type(up)(up.position - [0, 0, 0.2e-3], up.quaternion)}))
    assert feel(touching) is not None
    away, _ = rig.step(Action({"upper": type(up)(up.position + [0, 0, 1e-3], up.quaternion)}))
    assert feel(away) is None


def test_grip_closes_until_the_contact_is_firm_then_holds(open_springs: Any) -> None:
    rig = open_springs()
    policy = Grip(rig.spec, target=0.05)
    episode = run_episode(rig, policy, None, 30)
    signals = [np.mean([step.info[f"contact_signal_{name}"] for name in ("lower", "upper")]) for step in episode.steps]
    firm = int(np.argmax(np.array(signals) >= 0.05))
    assert 0 < firm < 30
    assert np.all(np.array(signals[:firm]) < 0.05)
    for step in episode.steps[1 : firm + 1]:
        assert step.action is not None
        assert all(pose is not None for pose in step.action.tool.values())
    first = episode.steps[1]
    assert first.sent["upper"] is not None
    down = first.sent["upper"].position - episode.steps[0].arms["upper"].pose.position
    assert down == pytest.approx([0, 0, -0.1e-3], abs=1e-12)  # along the sensor's own z: out of the gel
    for step in episode.steps[firm + 1 :]:
        assert step.action is not None
        assert set(step.action.tool.values()) == {None}


def test_grip_holds_for_good_even_when_the_contact_fades(open_springs: Any) -> None:
    rig = open_springs()
    faint = rig.reset()
    firm = replace(faint.tactile["lower"], image=np.full_like(faint.tactile["lower"].image, 200))
    policy = Grip(rig.spec)
    policy.reset()
    assert policy(faint).tool["lower"] is not None
    assert policy(Observation({"lower": firm, "upper": firm}, faint.arms, 0.1)).tool == {"lower": None, "upper": None}
    assert policy(faint).tool == {"lower": None, "upper": None}
    policy.reset()
    assert policy(faint).tool["lower"] is not None


def test_grip_addresses_a_sensor_without_arm_by_its_name(open_springs: Any) -> None:
    rig = open_springs()
    spec = replace(rig.spec, arms=(), sensors={"finger": replace(rig.spec.sensors["lower"], arm=None)})
    alone = Observation({"finger": rig.reset().tactile["lower"]}, {}, 0.0)
    target = Grip(spec)(alone).tool["finger"]
    assert target is not None
    assert target.position == pytest.approx([0, 0, 0.1e-3])
    assert np.array_equal(target.quaternion, [0, 0, 0, 1])


def by_the_expert(rig: Any, task: Any, steps: int) -> list[float]:
    """Distances of an episode that the expert plays."""
    observation, start = rig.reset(0), rig.truth()
    distances = [task.distance(start, start)]
    for _ in range(steps):
        poses = {name: arm.pose for name, arm in observation.arms.items()}
        vector = task.expert(rig.truth(), start)
        observation, _ = rig.step(action_of_vector(vector, task.axes, task.config.max_step, poses))
        distances.append(task.distance(rig.truth(), start))
    return distances


def test_the_expert_of_squeeze_is_there_in_the_fewest_steps(open_springs: Any) -> None:
    """Gels and body are springs of one stiffness, so the body gives a third of what the sensors close; they close by no
    more than 2 max_step in a step. That bounds every policy."""
    task = make_task(SqueezeConfig(kind="squeeze", goal=9.7e-3, max_step=0.1e-3))
    distances = by_the_expert(open_springs(), task, 10)
    fewest = math.ceil(3 * distances[0] / (2 * 0.1e-3))
    assert fewest == 5
    assert distances[fewest] < 1e-6 < distances[fewest - 1]
    assert max(distances[fewest:]) < 1e-6


def test_the_expert_of_reposition_goes_straight(open_springs: Any) -> None:
    task = make_task(REPOSITION)
    distances = by_the_expert(open_springs("reposition"), task, 40)
    assert distances[-1] < 0.02e-3
    assert task.expert(*(truth_at(x) for x in (0.0, 0.0))) == pytest.approx([1.0, -0.5])


def truth_at(x: float) -> Truth:
    return Truth(10e-3, np.array([x, 0.0, 5e-3]), np.zeros((1, 3), np.float32), {})

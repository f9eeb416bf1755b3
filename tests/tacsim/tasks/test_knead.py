"""Kneading: the solid of the body's volume, and a scripted policy that makes it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from scipy.stats import spearmanr

from robot.open import open_rig
from tacsim.config import load_rig
from tacsim.interface import ArmState, FloatArray, Pose, Truth
from tacsim.models.material import BodyMaterial
from tacsim.models.scene import Body, Box, Indenter, Scene
from tacsim.models.task import KneadConfig
from tacsim.tasks import evaluate_outcome, make_task
from tacsim.tasks.knead import (
    SAMPLE_POINTS,
    Knead,
    ScriptedKnead,
    Solid,
    centre_points,
    chamfer_distance,
    earth_movers_distance,
    intersection_over_union,
    select_evenly,
)
from tacsim.tasks.task import action_of_vector

V = 1e-6  # [m^3]: a cube of 10 mm


def cloud(size: tuple[float, float, float], spacing: float = 0.5e-3) -> np.ndarray:
    """A box as a lattice of particles, centred."""
    axes = [(np.arange(n) - (n - 1) / 2) * spacing for n in (round(s / spacing) for s in size)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def ball(radius: float, number: int = 20_000) -> np.ndarray:
    """A ball as points, by quantiles of the radius and a spiral of directions."""
    k = np.arange(number) + 0.5
    z = 1.0 - 2.0 * k / number
    turn = np.pi * (1 + 5**0.5) * k
    r = radius * np.random.default_rng(1).permutation(k / number) ** (1 / 3)
    s = np.sqrt(1 - z * z)
    return r[:, None] * np.stack([s * np.cos(turn), s * np.sin(turn), z], axis=1)


@pytest.mark.parametrize("slenderness", [1.0, 3.0])
def test_a_rod_has_the_volume_and_lies_along_x(slenderness: float) -> None:
    rod = Solid.make_rod(V, slenderness)
    length, width, height = rod.size
    assert width == pytest.approx(height) and length == pytest.approx(slenderness * width)
    assert np.pi / 4 * width**2 * length == pytest.approx(V)
    assert np.ptp(rod.points[:, 0]) == pytest.approx(length, rel=0.1)
    end = np.array([[length / 2 + 1e-3, 0, 0], [0, width / 2 + 1e-3, 0], [0, 0, 0.0]])
    assert rod.distance(end) == pytest.approx([1e-3, 1e-3, -min(width, length) / 2])


def test_a_ball_has_the_volume() -> None:
    assert np.pi / 6 * Solid.make_ball(V).size[0] ** 3 == pytest.approx(V)


def test_what_is_the_solid_is_at_no_distance() -> None:
    for solid in (Solid.make_ball(V), Solid.make_rod(V, 2.0)):
        body = solid.points
        assert chamfer_distance(body, solid, V) == pytest.approx(0.0, abs=1e-12)
        assert earth_movers_distance(select_evenly(body), solid.sample_points) == 0.0
        assert intersection_over_union(body, solid) == pytest.approx(1.0)


def test_chamfer_of_a_larger_ball() -> None:
    """Mean of r - R over a ball of radius S > R, where r > R: 3/S^3 (S^4/4 - R S^3/3 + R^4/12); and nothing of the
    solid lies outside, so half of it."""
    solid = Solid.make_ball(V)
    r = float(solid.size[0]) / 2
    s = 1.5 * r
    expected = 3 / s**3 * (s**4 / 4 - r * s**3 / 3 + r**4 / 12)
    assert chamfer_distance(ball(s), solid, V * 1.5**3) == pytest.approx(expected / 2, rel=0.01)


def test_chamfer_of_a_smaller_ball_is_the_other_half() -> None:
    solid = Solid.make_ball(V)
    r = float(solid.size[0]) / 2
    s = r / 1.5
    expected = 3 / r**3 * (r**4 / 4 - s * r**3 / 3 + s**4 / 12)
    body = ball(s, 100_000)
    reach = 0.5 * np.sqrt(3.0) * (V / 1.5**3 / len(body)) ** (1 / 3)
    found = chamfer_distance(body, solid, V / 1.5**3)
    assert expected / 2 - reach < found < expected / 2
    assert found == pytest.approx(expected / 2, rel=0.12)


def test_earth_movers_distance_of_a_shifted_cloud_is_the_shift() -> None:
    """No way to move a cloud onto its translate is shorter in the mean than to translate it (Jensen)."""
    one = select_evenly(cloud((10e-3, 10e-3, 10e-3)))
    assert len(one) == SAMPLE_POINTS
    assert earth_movers_distance(one, one + [3e-3, 0, -4e-3]) == pytest.approx(5e-3, rel=1e-12)


def test_earth_movers_distance_of_two_spheres_is_the_difference_of_their_radii() -> None:
    one = ball(1.0, 500)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    assert earth_movers_distance(one, 1.4 * one) == pytest.approx(0.4, rel=1e-6)


def test_iou_of_a_cube_and_a_ball() -> None:
    """The cube's corners beyond the ball are as much as the ball's six caps beyond the cube, of height h = r - a / 2
    and volume pi h^2 (3 r - h) / 3 each; they do not meet, since r < a / sqrt 2."""
    a, solid = 10e-3, Solid.make_ball(V)
    r = float(solid.size[0]) / 2
    h = r - a / 2
    caps = 6 * np.pi * h**2 * (3 * r - h) / 3
    assert r < a / np.sqrt(2)
    assert intersection_over_union(cloud((a, a, a), 0.25e-3), solid) == pytest.approx((V - caps) / (V + caps), abs=3e-3)


def test_iou_of_a_shifted_rod() -> None:
    """By s along its length L: (L - s) / (L + s)."""
    rod = Solid.make_rod(V, 2.0)
    length = float(rod.size[0])
    body = rod.points + [0.25 * length, 0, 0]
    assert intersection_over_union(body, rod) == pytest.approx(0.75 / 1.25, rel=0.03)
    assert intersection_over_union(rod.points + [2 * length, 0, 0], rod) == 0.0


def test_a_cloud_is_compared_where_it_lies_best() -> None:
    body = cloud((10e-3, 10e-3, 10e-3)) + [1.0, 2.0, 3.0]
    assert centre_points(body).mean(axis=0) == pytest.approx([0, 0, 0], abs=1e-12)
    assert chamfer_distance(centre_points(body), Solid.make_ball(V), V) < 1e-3


QUICK = [
    "scene.preset=learn",
    "motion=flowing",
    *(
        f"sensors.{n}.model.geometry.{w}"
        for n in ("lower", "upper")
        for w in ("width=16", "height=16", "pixel_pitch=1 mm")
    ),
]


def cube(side: float, spacing: float = 0.5e-3) -> Truth:
    axis = np.arange(spacing / 2, side, spacing)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3) + [0.1, 0.2, 0.3]
    return Truth(side, points.mean(axis=0), points.astype(np.float32), {})


def config(**changed: Any) -> KneadConfig:
    return KneadConfig(kind="knead", scene=Scene(body=Body(geometry=Box(size=(8e-3, 8e-3, 8e-3)))), **changed)


def test_the_solid_has_the_bodys_volume_and_its_size_is_the_goal() -> None:
    length, width, height = make_task(config(slenderness=3.0)).goal  # type: ignore[misc]
    assert np.pi / 4 * width * height * length == pytest.approx(512e-9)
    assert length / width == pytest.approx(3.0)
    assert make_task(config(shape="ball")).goal == pytest.approx([(6 * 512e-9 / np.pi) ** (1 / 3)] * 3)


def test_a_rig_with_another_body_kneads_that_one() -> None:
    loaded = load_rig(
        "sim", task="knead", overrides=["task.shape=ball", "scene.body.geometry.size=[6 mm, 6 mm, 10 mm]"]
    )
    assert loaded.config.task is not None
    assert make_task(loaded.config.task).goal == pytest.approx([(6 * 360e-9 / np.pi) ** (1 / 3)] * 3)


def test_a_cube_is_judged_where_it_lies() -> None:
    task = make_task(config(shape="ball"))
    outcome = evaluate_outcome(task, cube(8e-3), cube(8e-3))
    assert 0 < outcome.distance < 0.1e-3 and outcome.success
    measures = task.measures(cube(8e-3), cube(8e-3))
    assert measures["chamfer"] == outcome.distance
    assert measures["iou"] == pytest.approx(0.726, abs=0.02)  # tests/tacsim/tasks/test_knead.py
    assert {measures[f"{name}_improvement"] for name in ("chamfer", "earth_movers", "iou")} == {0.0}


def test_without_a_body_there_is_nothing_to_knead() -> None:
    scene = Scene(body=None, indenter=Indenter())
    with pytest.raises(ValueError, match="needs a scene with a body"):
        _ = make_task(KneadConfig(kind="knead", scene=scene)).goal


def kneaded(steps: int, policy: str, *overrides: str) -> tuple[dict[str, float], FloatArray]:
    """What an episode of so many steps ends with; and (n, 2) true and felt distance at each tenth step [m]."""
    loaded = load_rig("sim", task="knead", overrides=[*QUICK, *overrides])
    assert loaded.config.task is not None
    task, random = make_task(loaded.config.task), np.random.default_rng(1)
    with open_rig(loaded) as rig:
        observation = rig.reset(0)
        start, acts, feel = rig.truth(), task.scripted(through=True), task.estimator(loaded.config.canonical)
        assert start is not None
        both = []
        for step in range(steps):
            felt, now = feel(observation), rig.truth()
            if step % 10 == 0 and felt is not None and now is not None:
                both.append((task.distance(now, start), felt))
            poses = {name: arm.pose for name, arm in observation.arms.items()}
            vector = random.uniform(-1, 1, 4) * [0.2, 0.2, 1, 1]
            action = acts(observation) if policy == "scripted" else action_of_vector(vector, task.axes, 0.5e-3, poses)
            observation, _ = rig.step(action)
        truth = rig.truth()
    assert truth is not None
    return dict(task.measures(truth, start)), np.array(both)


@pytest.mark.deep
@pytest.mark.parametrize(
    ("overrides", "least"),
    [((), 0.25), (("task.shape=ball", "scene.body.geometry.size=[6 mm, 6 mm, 10 mm]"), 0.5)],
    ids=["rod", "ball"],
)
def test_the_scripted_policy_kneads_where_a_random_one_does_not(overrides: tuple[str, ...], least: float) -> None:
    (scripted, one), (random, other) = (kneaded(100, policy, *overrides) for policy in ("scripted", "random"))
    assert scripted["chamfer_improvement"] > least
    assert scripted["chamfer_improvement"] > 2 * random["chamfer_improvement"]
    true, felt = np.concatenate([one, other]).T
    assert len(true) > 15
    assert np.sqrt(np.mean((true - felt) ** 2)) < 0.1e-3
    assert spearmanr(true, felt)[0] > 0.6


def test_the_scripted_policy_turns_where_the_sensor_stands_not_by_the_clock() -> None:
    """An arm that does half of what it is asked turns a quarter turn of the rod to each side all the same."""
    task = make_task(config())
    assert isinstance(task, Knead)
    diameter = task.goal[2]
    for share in (1.0, 0.5):
        policy, now, way = ScriptedKnead(task, True), np.zeros(2), []
        for _ in range(int(300 / share)):
            step = policy._stroke_step(now)
            assert np.linalg.norm(step) <= 0.9 * task.config.max_step + 1e-12
            now = now + share * step
            way.append(now.copy())
        assert np.ptp(way, axis=0) == pytest.approx([0, np.pi * diameter], abs=2 * 0.2 * task.config.max_step)


def test_a_ball_is_rolled_on_a_circle() -> None:
    """From the middle it spirals out to 0.8 of the diameter, then goes round, with steps of 0.9 max_step."""
    task = make_task(config(shape="ball"))
    assert isinstance(task, Knead)
    policy, now, path = ScriptedKnead(task, True), np.zeros(2), []
    for _ in range(300):
        step = policy._circle_step(now)
        assert np.linalg.norm(step) == pytest.approx(0.9 * task.config.max_step, rel=0.02)
        now = now + step
        path.append(now.copy())
    radius = np.linalg.norm(path[100:], axis=1)
    assert radius == pytest.approx(0.8 * task.goal[2], rel=1e-6)
    assert np.ptp(path[100:], axis=0) == pytest.approx([2 * radius[0]] * 2, rel=0.01)


def taught(height: float, force: float, yields: float | None) -> float:
    """How far the teacher of a cube of 8 mm closes each sensor [m], which feel that height [m] and force [N]."""
    body = Body(geometry=Box(size=(8e-3, 8e-3, 8e-3)), material=BodyMaterial(yield_stress=yields))
    teacher = make_task(KneadConfig(kind="knead", scene=Scene(body=body))).teacher()
    teacher.reset()
    depth, wrench = 0.2e-3, np.array([0.0, 0.0, -force, 0.0, 0.0, 0.0])
    arms = {
        name: ArmState(Pose(np.array([0.0, 0.0, z])), np.zeros(6), wrench, None, 0.0)
        for name, z in (("lower", 0.0), ("upper", height - 2 * depth))
    }
    touch = SimpleNamespace(height=np.full((2, 2), depth), valid=np.ones((2, 2), np.bool_))
    seen = SimpleNamespace(arms=arms, tactile=dict.fromkeys(arms, touch))
    pose = teacher(seen).tool["lower"]  # type: ignore[arg-type]
    assert pose is not None
    return float(pose.position[2])


def test_the_teacher_closes_by_what_is_left_of_the_height_and_no_more_than_the_clay_can_bear() -> None:
    goal = (2 * 512e-9 / np.pi) ** (1 / 3)
    assert taught(goal + 1.2e-3, 0.0, 20e3) == pytest.approx(0.02e-3)
    assert taught(goal + 0.3e-3, 0.0, 20e3) == pytest.approx(0.005e-3)
    assert taught(goal, 0.0, 20e3) == pytest.approx(0.0, abs=1e-12)
    assert taught(goal - 0.3e-3, 0.0, 20e3) == pytest.approx(-0.005e-3)
    most = 0.9 * 20e3 * 64e-6
    assert taught(goal + 1.2e-3, most - 0.1, 20e3) == pytest.approx(0.05e-3 * 0.1)
    assert taught(goal + 1.2e-3, most + 0.1, 20e3) == pytest.approx(-0.05e-3 * 0.1)
    assert taught(goal + 1.2e-3, 12e3 * 64e-6, None) == pytest.approx(0.0)  # elastic: as the scripted policy


def test_its_environment_measures_at_the_end() -> None:
    env = gymnasium.make(
        "tacsim.gym:tacsim/Knead-v0", overrides=[*QUICK, "task.steps=2"], features={"grid": {"rows": 8, "columns": 8}}
    )
    observation, info = env.reset(seed=1)
    assert env.action_space.shape == (4,) and observation["goal"].shape == (3,)
    assert "iou" not in info and info["peak_force"] > 0 and info["work"] == 0.0
    *_, truncated, info = env.step(np.array([1, -1, 0, 0.5], np.float32))
    assert not truncated and "iou" not in info and info["work"] > 0
    *_, truncated, info = env.step(np.array([0, 0, 0, 0.5], np.float32))
    assert truncated and 0 < info["iou"] < 1 and info["chamfer"] == info["distance"]
    env.close()

"""An elastic mount: the sensor gives way by force / stiffness, and the arm does not observe it."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from robot.open import open_rig
from tacsim import Action, Pose
from tacsim.models.hardware import MountConfig
from tacsim.sim.mount import ElasticMount, elastic_mounts
from tests.tacsim.gym.small import SMALL


def make_mount(stiffness: float, damping_time: float = 0.3) -> ElasticMount:
    mount = elastic_mounts({"upper": MountConfig(stiffness=stiffness, damping_time=damping_time)}, period=0.1)["upper"]
    assert mount is not None
    return mount


def test_displacement_approaches_force_over_stiffness() -> None:
    """At constant force F the displacement after n periods T is F/K (1 - exp(-n T / tau)), from rest without force."""
    mount = make_mount(2000.0, damping_time=0.4)
    sensor, force = np.array([0.0, 0.0, 0.01]), np.array([0.0, 1.0, -4.0])
    assert mount.arm_position(sensor, np.zeros(3)) == pytest.approx(sensor)
    for count in range(1, 6):
        sensor = mount.move_arm(np.array([0.0, 0.0, 0.01]), sensor, force)
        wanted = force / 2000.0 * (1 - np.exp(-count * 0.1 / 0.4))
        assert sensor - [0.0, 0.0, 0.01] == pytest.approx(wanted, abs=1e-12)


def test_episode_begins_at_rest_under_its_force() -> None:
    mount = make_mount(1000.0)
    force = np.array([0.0, 0.0, -2.0])
    assert mount.arm_position(np.zeros(3), force) == pytest.approx([0.0, 0.0, 2e-3])
    assert mount.move_arm(np.array([0.0, 0.0, 2e-3]), np.zeros(3), force) == pytest.approx(np.zeros(3), abs=1e-15)
    mount.begin()
    assert mount.arm_position(np.zeros(3), np.zeros(3)) == pytest.approx(np.zeros(3))


def test_a_stiff_contact_pushes_back_less_while_the_mount_gives_way() -> None:
    """Pressed by L into a wall of stiffness C, a mount of stiffness K approaches L K / (K + C) as
    exp(-n (1 + C / K) T / tau), though the force at the start of each period alone would make it oscillate."""
    stiffness, wall, press = 930.0, 6000.0, 0.2e-3
    mount = make_mount(stiffness)
    end, decay = press * stiffness / (stiffness + wall), np.exp(-(1 + wall / stiffness) * 0.1 / 0.3)
    target, sensor = np.array([0.0, 0.0, press]), np.zeros(3)
    for count in range(8):
        sensor = mount.move_arm(target, sensor, np.array([0.0, 0.0, -wall * sensor[2]]))
        assert sensor[2] == pytest.approx(end + (press - end) * decay**count, rel=1e-9)


@pytest.mark.parametrize("stiffness", [(930.0, 1470.0), (800.0, 10000.0), (500.0, 500.0)])
@pytest.mark.parametrize("body", [300.0, 3000.0, 30000.0])
def test_two_mounts_and_a_body_relax_as_three_springs_and_two_dampers(
    stiffness: tuple[float, float], body: float
) -> None:
    """Arms that have closed in by L wait: the force approaches L / (1 / C + S) as exp(-(1 + C S) n T / tau),
    S = 1 / K1 + 1 / K2."""
    configs = {name: MountConfig(stiffness=each) for name, each in zip(("lower", "upper"), stiffness, strict=True)}
    mounts = elastic_mounts(configs, period=0.1)
    arms = {"lower": 0.3e-3, "upper": 9.8e-3}
    sensors = {"lower": np.zeros(3), "upper": np.array([0.0, 0.0, 10e-3])}
    compliance = sum(1 / each for each in stiffness)
    end, decay = 0.5e-3 / (1 / body + compliance), np.exp(-(1 + body * compliance) * 0.1 / 0.3)
    for count in range(10):
        force = body * (10e-3 - float(sensors["upper"][2] - sensors["lower"][2]))
        if count > 0:
            assert force == pytest.approx(end + (body * 0.5e-3 - end) * decay ** (count - 1), rel=1e-9)
        before = dict(sensors)
        for name, sign, other in (("lower", -1.0, "upper"), ("upper", 1.0, "lower")):
            mount, target, push = mounts[name], np.array([0.0, 0.0, arms[name]]), np.array([0.0, 0.0, sign * force])
            assert mount is not None
            sensors[name] = mount.move_arm(target, before[name], push, [before[other]])


def test_rigid_mount_is_none_and_a_soft_one_is_refused() -> None:
    assert elastic_mounts({"upper": MountConfig()}, 0.1) == {"upper": None}
    assert MountConfig.model_validate({"stiffness": "2 N/mm"}).stiffness == 2000.0
    with pytest.raises(ValidationError):
        MountConfig(stiffness=100.0)


@pytest.mark.slow
def test_body_is_squeezed_less_than_the_arms_close() -> None:
    """Both arms close by 1 mm and wait; the sensors are back by force / stiffness of each, which no arm
    reports. A rig without mounts closes by 1 mm exactly."""
    gaps, forces, reported = {}, {}, {}
    for name, stiffness in (("rigid", "null"), ("soft", "1 N/mm")):
        words = [f"arms.{arm}.mount.stiffness={stiffness}" for arm in ("lower", "upper")]
        with open_rig("sim", task="squeeze", overrides=[*SMALL, *words]) as rig:
            observation = rig.reset(0)
            start = {arm: state.pose for arm, state in observation.arms.items()}
            truth = rig.truth()
            assert truth is not None
            before = truth.poses["upper"].position[2] - truth.poses["lower"].position[2]
            for number in range(1, 31):
                way = min(number * 0.1e-3, 0.5e-3)
                targets = {
                    arm: Pose(pose.position + [0.0, 0.0, way if arm == "lower" else -way], pose.quaternion)
                    for arm, pose in start.items()
                }
                observation, _ = rig.step(Action(targets if number <= 5 else {"lower": None, "upper": None}))
            truth = rig.truth()
            assert truth is not None
            gaps[name] = before - (truth.poses["upper"].position[2] - truth.poses["lower"].position[2])
            arms = observation.arms
            reported[name] = sum(abs(arms[arm].pose.position[2] - start[arm].position[2]) for arm in arms)
            forces[name] = sum(-float(state.wrench[2]) for state in arms.values())
    assert reported["rigid"] == pytest.approx(1e-3, abs=1e-9) and reported["soft"] == pytest.approx(1e-3, abs=1e-9)
    assert gaps["rigid"] == pytest.approx(1e-3, abs=1e-9)
    touch = 2 * 0.05  # at the reset, about: the mounts were at rest under it [N]
    assert gaps["soft"] == pytest.approx(1e-3 - (forces["soft"] - touch) / 1000.0, abs=0.03e-3)
    assert gaps["soft"] < 0.9e-3 and forces["soft"] < forces["rigid"]

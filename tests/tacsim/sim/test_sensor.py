"""The simulator behind the contract: sensors, arms, clock and start of one world."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tacsim.control import NoTouch
from tacsim.interface import Pose, SensorSpec
from tacsim.limits import LimitExceeded
from tacsim.models.limits import ArmLimits, Workspace
from tacsim.physics.move import MoveStats
from tacsim.sim.arm import SimArm
from tacsim.sim.clock import SimClock
from tacsim.sim.reset import SimReset, approach_force
from tacsim.sim.scene_world import SceneWorld, StatePool
from tacsim.sim.sensor import SimSensor
from tacsim.sim.tuning import TOUCH_TOLERANCE


def shifted(pose: Pose, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Pose:
    return Pose(pose.position + [x, y, z], pose.quaternion)


@pytest.mark.parametrize("touch_force", [0.01, 0.05, 0.3, 3.0, 10.0])
def test_approach_ends_in_gentle_contact_on_both_gels(spring_world: Any, touch_force: float) -> None:
    stats = approach_force(spring_world, touch_force)
    forces = [-spring_world.wrench(name)[2] for name in spring_world.sensors]
    assert all(touch_force <= force <= touch_force * (1 + TOUCH_TOLERANCE) for force in forces)
    assert spring_world.worst <= touch_force * (1 + TOUCH_TOLERANCE)  # what pressed harder was taken back
    assert stats is not None
    assert stats.settled
    assert len(spring_world.moves) < 60


def test_contact_that_begins_at_a_distance_is_gentle_too(spring_world: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a grid shared by gels and body: the fast part of the approach already presses, and is taken back."""

    def reach(self: Any) -> float:
        gap = self.poses["upper"].position[2] - self.poses["lower"].position[2]
        return float(max(0.0, (10.6e-3 - gap) * 2e3))

    monkeypatch.setattr(type(spring_world), "force", property(reach))
    approach_force(spring_world, 0.05)
    assert 0.05 <= spring_world.force <= 0.06
    assert spring_world.worst <= 0.06


def test_approach_moves_both_sensors_alike(spring_world: Any) -> None:
    before = {name: spring_world.pose(name).position[2] for name in spring_world.sensors}
    approach_force(spring_world, 0.05)
    moved = {name: spring_world.pose(name).position[2] - before[name] for name in spring_world.sensors}
    assert moved["lower"] > 0.4e-3
    assert moved["lower"] == pytest.approx(-moved["upper"], abs=1e-9)


def test_approach_gives_up_where_nothing_is(spring_world: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(spring_world), "force", 0.0)
    with pytest.raises(NoTouch, match=r"normal force 0 N, 0.05 N wanted, after 80 moves"):
        approach_force(spring_world, 0.05)


def test_approach_gives_up_at_a_force_that_jumps(spring_world: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def jump(self: Any) -> float:
        gap = self.poses["upper"].position[2] - self.poses["lower"].position[2]
        return 0.0 if gap > 9.99e-3 else 5.0

    monkeypatch.setattr(type(spring_world), "force", property(jump))
    with pytest.raises(NoTouch, match="settling tolerance"):
        approach_force(spring_world, 0.05)


def make_arms(world: Any, longest: float = 1.0) -> tuple[SimClock, SimArm, SimArm]:
    clock = SimClock(world, 0.1)
    return clock, SimArm(world, clock, "lower", longest, 1.0), SimArm(world, clock, "upper", longest, 1.0)


def test_tick_moves_all_arms_in_one_motion(spring_world: Any) -> None:
    clock, lower, upper = make_arms(spring_world)
    targets = {"lower": shifted(Pose(), z=1e-4), "upper": shifted(spring_world.pose("upper"), z=-1e-4)}
    assert lower.command(targets["lower"]) is targets["lower"]
    upper.command(targets["upper"])
    assert spring_world.moves == []  # commanding moves nothing yet
    clock.tick()
    assert spring_world.moves == [targets]
    assert clock.now() == pytest.approx(0.1)
    assert upper.state().pose is targets["upper"]
    assert upper.state().time == clock.now()


def test_twist_is_the_mean_velocity_of_the_period_in_world_axes(spring_world: Any) -> None:
    clock, _, upper = make_arms(spring_world)
    assert not upper.state().twist.any()
    turn = np.array([0.0, 0.0, np.sin(0.05), np.cos(0.05)])  # 0.1 rad about world z, before the half turn about x
    start = spring_world.pose("upper")
    half_turn_after = np.array([turn[3], turn[2], 0.0, 0.0])  # turn * (1, 0, 0, 0)
    upper.command(Pose(start.position + [1e-3, 2e-3, 0.0], half_turn_after))
    clock.tick()
    assert upper.state().twist == pytest.approx([1e-2, 2e-2, 0.0, 0.0, 0.0, 1.0])
    clock.tick()
    assert not upper.state().twist.any()


def test_a_settled_world_that_is_told_to_hold_is_left_alone(spring_world: Any) -> None:
    clock, lower, _ = make_arms(spring_world)
    assert lower.command(None) is None
    clock.tick()
    assert spring_world.moves == []
    assert clock.now() == pytest.approx(0.1)


def test_an_unsettled_world_settles_further_while_it_holds(spring_world: Any) -> None:
    clock, _, _ = make_arms(spring_world)
    clock.restart(MoveStats(100, 50, 0.5, False, 0.0, 0))
    clock.tick()
    assert spring_world.moves == [{}]
    assert clock.diagnostics()["settled"] == 1.0


def test_stop_drops_what_was_commanded(spring_world: Any) -> None:
    clock, lower, _ = make_arms(spring_world)
    lower.command(shifted(Pose(), z=1e-4))
    lower.stop()
    clock.tick()
    assert spring_world.moves == []


def test_a_motion_beyond_the_limit_is_shortened_told_and_counted(spring_world: Any) -> None:
    clock, lower, _ = make_arms(spring_world, longest=2e-3)
    asked = shifted(Pose(), x=3e-3, z=4e-3)
    sent = lower.command(asked)
    assert sent is not None
    assert sent.position == pytest.approx([1.2e-3, 0.0, 1.6e-3])
    clock.tick()
    assert spring_world.moves == [{"lower": sent}]
    assert clock.diagnostics()["shortened"] == 1.0
    lower.command(shifted(sent, z=1e-3))
    clock.tick()
    assert clock.diagnostics()["shortened"] == 0.0


def test_a_picture_is_rendered_when_it_is_looked_at_and_once(spring_world: Any) -> None:
    """Whatever has happened since: it shows the gel as it was when the frame was read."""
    clock, lower, _ = make_arms(spring_world)
    approach_force(spring_world, 1.0)  # untouched, all states look alike
    rendered: list[float] = []

    def render(surface: Any) -> np.ndarray:
        rendered.append(1e3 * float(np.abs(surface.displacement).max()))
        return np.full((4, 6, 3), len(rendered), np.uint8)

    spec = SensorSpec((4, 6), height=True, flow=False, arm="lower")
    sensor = SimSensor(spring_world, clock, "lower", spec, render, lambda surface: None)  # type: ignore[arg-type, return-value]
    clock.tick()
    first = sensor.read(0.0)
    assert sensor.read(0.0) is first
    was = 1e3 * float(np.abs(spring_world.surface("lower").displacement).max())
    lower.command(shifted(Pose(), z=1e-4))
    clock.tick()
    second = sensor.read(0.0)
    assert rendered == []
    assert first.image is first.image and (first.image == 1).all()
    assert rendered == [was]
    assert (second.image == 2).all() and rendered[1] != was
    assert (first.index, second.index) == (0, 1)
    assert second.time == pytest.approx(0.2)


def test_an_untouched_gel_is_drawn_once(spring_world: Any) -> None:
    """Each episode begins with its picture; who writes into one does not change the next."""
    clock, *_ = make_arms(spring_world)
    rendered: list[None] = []

    def render(surface: Any) -> np.ndarray:
        rendered.append(None)
        return np.full((4, 6, 3), 7, np.uint8)

    spec = SensorSpec((4, 6), height=True, flow=False, arm="lower")
    sensor = SimSensor(spring_world, clock, "lower", spec, render, lambda surface: None)  # type: ignore[arg-type, return-value]
    for episode in range(3):
        clock.restart()
        sensor.restart(episode)
        image = sensor.read(0.0).image
        assert (image == 7).all()
        image[...] = 0
    assert len(rendered) == 1


def test_placement_follows_the_seed(open_springs: Any) -> None:
    rig = open_springs("squeeze", "task.placement=1 mm")
    places = [rig.reset(seed).arms["lower"].pose.position[:2] for seed in (1, 2, 1)]
    assert np.array_equal(places[0], places[2])
    assert not np.array_equal(places[0], places[1])
    assert 0 < np.abs(places).max() <= 1e-3
    upper = rig.reset(1).arms["upper"].pose.position[:2]
    assert np.array_equal(upper, places[0])


def test_an_arm_with_an_error_measures_its_start_and_is_not_there(open_springs: Any) -> None:
    """As on a robot; the next episode begins at the same place."""
    nominal = open_springs("squeeze").reset(0).arms["lower"].pose.position[:2]
    rig = open_springs("squeeze", "arms.lower.error.position=[0.6 mm, 0.3 mm, 0]")
    for seed in (0, 1):
        assert rig.reset(seed).arms["lower"].pose.position[:2] == pytest.approx(nominal, abs=1e-12)
        assert rig.world.pose("lower").position[:2] == pytest.approx(nominal - [0.6e-3, 0.3e-3], abs=1e-12)
    placed = open_springs("squeeze", "task.placement=1 mm").reset(1).arms["lower"].pose.position
    error = "arms.lower.error.position=[0.6 mm, 0.3 mm, 0]"
    found = open_springs("squeeze", "task.placement=1 mm", error).reset(1).arms["lower"].pose.position
    assert found == pytest.approx(placed, abs=1e-9)


def test_without_touch_force_the_gels_stay_clear(spring_world: Any) -> None:
    clock = SimClock(spring_world, 0.1)
    SimReset(SceneWorld(spring_world.scene, lambda scene: spring_world), clock, {}, {}, None).touch()
    assert spring_world.moves == []


def test_a_dynamic_clock_gives_every_period_its_own_time(spring_world: Any) -> None:
    """Also one in which nothing is commanded: what moves goes on moving."""
    clock = SimClock(spring_world, 0.1, motion="dynamic")
    clock.tick()
    clock.command("lower", shifted(Pose(), z=1e-4), limited=False)
    clock.tick()
    assert spring_world.durations == [0.1, 0.1]
    assert clock.now() == pytest.approx(0.2)


def test_a_flowing_clock_waits_for_rest_once_nothing_is_commanded(spring_world: Any) -> None:
    clock = SimClock(spring_world, 0.1, motion="flowing")
    clock.command("lower", shifted(Pose(), z=1e-4), limited=False)
    clock.tick()
    assert clock.diagnostics()["settled"] == 0.0
    clock.tick()
    assert clock.diagnostics()["settled"] == 1.0
    clock.tick()  # at rest: the world is left as it is
    assert spring_world.flows == [True, True]
    assert clock.diagnostics()["substeps"] == 0.0


def guarded(world: Any, **changes: Any) -> tuple[SimClock, SimArm, SimArm]:
    """Two arms 10 mm apart in a box that ends 1 mm below the upper one; 8 mm of their way are kept out."""
    box = Workspace(lower=(-0.01, -0.01, -0.001), upper=(0.01, 0.01, 0.02))
    limits = ArmLimits(workspace=box, **changes)
    clock = SimClock(world, 0.1)
    apart = {"lower": [("upper", 8e-3)], "upper": [("lower", 8e-3)]}
    lower, upper = (SimArm(world, clock, name, 1.0, 1.0, limits, apart[name]) for name in ("lower", "upper"))
    return clock, lower, upper


def test_a_simulated_arm_stays_inside_its_workspace_and_away_from_the_other(spring_world: Any) -> None:
    clock, lower, upper = guarded(spring_world)
    start = spring_world.pose("upper")
    aside = upper.command(shifted(start, x=0.02))
    assert aside is not None
    assert aside.position[0] == pytest.approx(0.01)  # the wall
    clock.drop_commands()
    gap = float(start.position[2]) - 8e-3
    assert gap > 0
    near = [lower.command(shifted(Pose(), z=0.8 * gap)), upper.command(shifted(start, z=-0.8 * gap))]
    assert near[0] is not None
    assert near[1] is not None
    assert near[1].position[2] - near[0].position[2] == pytest.approx(8e-3)  # the second knows where the first goes
    clock.tick()
    assert clock.diagnostics()["shortened"] == 1.0


def test_a_simulated_arm_that_feels_too_much_follows_nothing(spring_world: Any) -> None:
    clock, lower, upper = guarded(spring_world, force=3.0)
    approach_force(spring_world, 4.0)
    with pytest.raises(LimitExceeded, match=r"arm of 'upper' felt more than limits.force .* of 3 N"):
        upper.command(shifted(spring_world.pose("upper"), z=-1e-4))
    moved = len(spring_world.moves)
    clock.tick()
    assert len(spring_world.moves) == moved
    with pytest.raises(LimitExceeded):
        lower.command(None)


def test_every_picture_says_how_its_state_was_reached(spring_world: Any) -> None:
    clock, lower, _ = make_arms(spring_world)
    spec = SensorSpec((4, 6), height=True, flow=False, arm="lower")
    image = np.zeros((4, 6, 3), np.uint8)
    sensor = SimSensor(spring_world, clock, "lower", spec, lambda surface: image, lambda surface: None)  # type: ignore[arg-type, return-value]
    assert sensor.read(0.0).stats == {}
    lower.command(shifted(Pose(), z=1e-4))
    clock.tick()
    stats = sensor.read(0.0).stats
    assert stats == clock.diagnostics()
    assert stats["residual"] == 0.001
    assert stats.keys() == {
        "substeps", "hold", "residual", "settled", "overlap", "guard_hits", "retries", "load_error", "time_step",
        "damping", "courant", "gel_overlap", "smallest_volume", "largest_volume", "particle_layers", "few_layers",
        "force_loss", "shortened",
    }  # fmt: skip
    assert all(type(value) is float for value in stats.values())


def test_noise_is_another_in_each_sensor_frame_and_episode_and_the_same_again(open_springs: Any) -> None:
    plain = open_springs()
    noise = "{deviation: [2, 2, 2]}"
    rig = open_springs("squeeze", *(f"sensors.{name}.model.noise={noise}" for name in ("lower", "upper")))
    plain.reset()
    still = {name: frame.image.astype(float) for name, frame in plain.references.items()}
    seen: dict[int, list[dict[str, np.ndarray]]] = {}
    for episode in (3, 3, 4):
        rig.reset(seed=episode)
        seen.setdefault(episode, []).append({name: frame.image for name, frame in rig.references.items()})
    for name in ("lower", "upper"):
        np.testing.assert_array_equal(seen[3][0][name], seen[3][1][name])
        assert (seen[3][0][name] != seen[4][0][name]).any()
        assert (seen[3][0][name] - still[name]).std() == pytest.approx(2.0, rel=0.1)
    lower, upper = ((seen[3][0][name] - still[name]).ravel() for name in ("lower", "upper"))
    assert abs(np.corrcoef(lower, upper)[0, 1]) < 0.2


def test_a_start_that_comes_again_is_not_approached_again(open_springs: Any) -> None:
    """Whatever the seed, where it makes no difference; a state is kept, so none of the moves is repeated."""
    rig = open_springs("squeeze")
    first = rig.reset(0)
    moved = len(rig.world.moves)
    for seed in range(1, 9):
        again = rig.reset(seed)
        assert again.arms["upper"].pose.position.tobytes() == first.arms["upper"].pose.position.tobytes()
    assert len(rig.world.moves) == moved


def test_a_pool_keeps_the_states_used_last() -> None:
    state = {"x": np.zeros(100)}  # 800 bytes
    pool = StatePool(max_bytes=2000)
    for key in ("a", "b"):
        pool.store(key, state, None)
    assert pool.find("a") == (state, None)
    pool.store("c", state, None)
    assert pool.find("b") is None and pool.find("a") is not None and pool.find("c") is not None


@pytest.mark.parametrize("shape", ["flat", "ball"])
def test_an_approach_that_knows_its_gap_takes_few_steps(
    spring_world: Any, monkeypatch: pytest.MonkeyPatch, shape: str
) -> None:
    """A gap is closed at once, for nothing touches. Then contact is sought just behind it: a flat body needs two
    steps, a ball (force ~ d^1.5) three more."""

    def force(self: Any) -> float:
        gap = self.poses["upper"].position[2] - self.poses["lower"].position[2]
        depth = max(0.0, (10e-3 - gap) / 2)
        return 8e3 * depth if shape == "flat" else 2e4 * depth**1.5

    monkeypatch.setattr(type(spring_world), "force", property(force))
    approach_force(spring_world, 0.05)
    assert 0.05 <= spring_world.force <= 0.06
    assert len(spring_world.moves) <= (2 if shape == "flat" else 5)

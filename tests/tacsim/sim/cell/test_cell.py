"""Cells in MuJoCo: a hand and an arm hold, lift and drop an object, and every state can be restored."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from robot.common.kinematics import Kinematics
from tacsim import pose as se3
from tacsim.control import NoTouch, ObjectDropped
from tacsim.interface import Pose
from tacsim.limits import LimitExceeded
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.sim.cell.cell import Cell
from tacsim.sim.cell.motion import DynamicMotion
from tacsim.sim.cell.reset import open_around
from tests.tacsim.sim.cell.cells import above, hand, let_pass, scene, ur5e

WEIGHT = 0.1 * 9.81


def gripped(cell: Cell, force: float, arm: str = "hand") -> Cell:
    open_around(cell, "hand", arm)
    DynamicMotion().grip(cell, {"hand": arm}, force)
    return cell


@pytest.fixture(scope="module")
def held() -> Cell:
    return gripped(hand(), 3.0)


def test_a_hand_begins_open_around_an_object_that_rests_on_its_pedestal() -> None:
    cell = hand()
    assert cell.grippers["hand"].width == pytest.approx(0.06)
    assert cell.pose("hand").position == pytest.approx([0, 0, 0.038])
    assert cell.object_pose().position == pytest.approx([0, 0, 0.038])
    left, right = cell.pose("hand/left"), cell.pose("hand/right")
    assert se3.rotation_matrix(left)[:, 2] == pytest.approx([1, 0, 0])  # out of the gel, to the object
    assert se3.rotation_matrix(right)[:, 2] == pytest.approx([-1, 0, 0])
    assert se3.rotation_matrix(left)[:, 1] == pytest.approx([0, 0, -1])  # rows of the picture: to the finger tips
    let_pass(cell, 0.1)
    assert np.abs(cell.object_pose().position - [0, 0, 0.038]).max() < 50e-6


def test_a_grip_carries_the_weight_without_its_pedestal(held: Cell) -> None:
    assert not held.has_pedestal
    assert held.normal_force("hand/left") == pytest.approx(3.0, rel=0.02)
    assert held.normal_force("hand/right") == pytest.approx(3.0, rel=0.02)
    force = se3.rotate(held.pose("hand"), held.wrench("hand")[:3])
    assert np.linalg.norm(force - [0, 0, -WEIGHT]) < 5e-3 * WEIGHT  # it moves by less than 0.2 mm/s
    assert held.slip_share("hand/left") == pytest.approx(WEIGHT / 2 / (0.6 * 3.0), rel=0.02)
    truth = held.truth()
    assert truth.height == pytest.approx(0.016, rel=1e-4)
    assert truth.position == pytest.approx(truth.objects["object"].position)
    assert np.ptp(truth.points[:, 0]) == pytest.approx(0.02, rel=1e-4)


def test_a_hand_is_exactly_where_it_is_sent_while_it_holds(held: Cell) -> None:
    state = held.snapshot()
    begin, before = held.pose("hand"), held.object_pose()
    for number in range(1, 5):
        target = above(begin, 1e-3 * number)
        let_pass(held, 0.05, {"hand": target})
        assert se3.pose_distance(held.pose("hand"), target)[0] < 1e-8
    turned = se3.compose(target, se3.from_rotation_vector(np.zeros(3), [0.0, 0.02, 0.01]))
    let_pass(held, 0.05, {"hand": turned})
    assert max(se3.pose_distance(held.pose("hand"), turned)) < 1e-6
    let_pass(held, 0.15)
    assert held.object_pose().position[2] - before.position[2] == pytest.approx(4e-3, abs=0.1e-3)
    held.restore(state)


def test_the_same_steps_after_a_restore_have_the_same_bits(held: Cell) -> None:
    state, ends = held.snapshot(), []
    for _ in range(2):
        let_pass(held, 0.05, {"hand": above(held.pose("hand"), 1e-3)})
        held.grippers["hand"].command(0.0, 2.0)
        let_pass(held, 0.05)
        ends.append((held.data.qpos.copy(), held.touch.wrenches, held.surface("hand/left").displacement.copy()))
        held.restore(state)
    for first, second in zip(*ends, strict=True):
        assert np.array_equal(first, second)


def test_an_opened_hand_drops_its_object(held: Cell) -> None:
    state = held.snapshot()
    held.grippers["hand"].command(0.05, 1.0)
    with pytest.raises(ObjectDropped, match="'object' was dropped"):
        let_pass(held, 0.5)
    held.restore(state)


def test_an_object_that_has_landed_within_milliseconds_was_dropped_too() -> None:
    cell = hand(scene({"pedestal": 0.004}))
    open_around(cell, "hand", "hand")
    DynamicMotion().grip(cell, {"hand": "hand"}, 3.0)
    cell.grippers["hand"].command(0.05, 1.0)
    with pytest.raises(ObjectDropped, match="'object' was dropped"):
        let_pass(cell, 0.3)


def test_an_object_without_pedestal_and_grip_falls() -> None:
    cell = hand()
    cell.take_pedestal_away()
    with pytest.raises(ObjectDropped, match=r"the object falls.*was its pedestal taken away before it was gripped"):
        let_pass(cell, 0.1)


def test_a_heavy_bar_that_is_held_off_its_centre_begins_when_it_swings_no_more() -> None:
    bar = {"geometry": {"shape": "box", "size": [0.016, 0.08, 0.008]}, "mass": 0.2, "friction": 0.9}
    off_centre = {"grip": [0.0, 0.014, 0.0], "pedestal": 0.06}
    cell = gripped(hand(scene({**bar, **off_centre}, gel={"housing": None})), 8.0)
    moment = cell.wrench("hand")[3:]
    assert np.linalg.norm(moment) == pytest.approx(0.2 * 9.81 * 0.014, rel=0.05)
    assert cell.object_speed()[1] < 0.02


def test_an_object_that_is_put_down_is_not_dropped() -> None:
    cell = hand(scene({"pedestal": 0.0}))
    open_around(cell, "hand", "hand")
    DynamicMotion().grip(cell, {"hand": "hand"}, 3.0)
    cell.grippers["hand"].command(0.05, 1.0)
    let_pass(cell, 0.3)
    assert cell.object_pose().position[2] == pytest.approx(0.008, abs=50e-6)


def test_a_gripper_stops_at_its_width_and_closes_no_faster_than_it_may() -> None:
    cell = hand(speed=0.02)
    cell.grippers["hand"].command(0.04, 5.0)
    let_pass(cell, 0.1)
    assert 0.06 - 2 * 0.02 * 0.1 <= cell.grippers["hand"].width < 0.06 - 1e-3
    let_pass(cell, 0.8)
    assert cell.grippers["hand"].width == pytest.approx(0.04, abs=1e-5)
    assert cell.grippers["hand"].force == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize(
    ("thing", "force", "message"),
    [
        ({"mass": 0.5}, 3.0, "a grip of 3 N cannot carry.*touch_force must be more than 4.088 N"),
        ({"position": [0.0, 0.05]}, None, ""),
    ],
)
def test_a_grip_that_cannot_hold_is_refused(thing: dict[str, object], force: float | None, message: str) -> None:
    cell = hand(scene(thing), starts={"hand": Pose(np.array([0, 0, 0.038]), se3.HALF_TURN_X.quaternion)})
    with pytest.raises(NoTouch, match=message or "the grippers closed and found no grip"):
        gripped(cell, 3.0 if force is None else force)


def test_an_object_wider_than_the_hand_opens_is_refused() -> None:
    cell = hand(scene({"geometry": {"shape": "box", "size": [0.058, 0.01, 0.01]}}))
    with pytest.raises(ValueError, match=r"58 mm wide where gripper 'hand' closes.*must open by 62 mm.*opens by 60 mm"):
        open_around(cell, "hand", "hand")


def test_an_object_wider_than_the_gel_ends_at_its_housing() -> None:
    cell = hand(scene({"geometry": {"shape": "box", "size": [0.02, 0.03, 0.03]}}))
    open_around(cell, "hand", "hand")
    cell.grippers["hand"].command(0.0, 60.0)
    with pytest.raises(LimitExceeded, match=r"wider than the gel and reaches .* into the housing"):
        let_pass(cell, 0.5)


def test_a_timestep_too_long_for_gel_and_finger_is_refused() -> None:
    stiff = {"material": {"youngs_modulus": 1e6}}
    with pytest.raises(ValueError, match=r"timestep of 0.005 s is too long for pad 'hand/left_pad'.*at most"):
        hand(scene(timestep=5e-3, gel=stiff), finger_mass=0.05)


def test_a_period_of_no_whole_number_of_timesteps_is_refused() -> None:
    with pytest.raises(ValueError, match=r"0.0505 s is no whole number of timesteps of 0.001 s"):
        let_pass(hand(), 0.0505, period=0.0505)


@pytest.mark.slow
def test_a_mesh_is_held_as_the_box_that_it_draws(tmp_path: Path) -> None:
    path = tmp_path / "box.stl"
    trimesh.creation.box((20.0, 14.0, 16.0)).export(path)
    cell = gripped(hand(scene({"geometry": {"shape": "mesh", "path": str(path), "scale": 1e-3}})), 3.0)
    assert cell.normal_force("hand/left") == pytest.approx(3.0, rel=0.02)
    assert float(cell.model.body("object").mass[0]) == pytest.approx(0.1)


def test_a_mesh_with_holes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "open.stl"
    box = trimesh.creation.box((20.0, 14.0, 16.0))
    trimesh.Trimesh(box.vertices, box.faces[1:]).export(path)
    with pytest.raises(ValueError, match=r"not closed|hole"):
        hand(scene({"geometry": {"shape": "mesh", "path": str(path), "scale": 1e-3}}))


def test_fixtures_carry_an_object() -> None:
    shelf = {"geometry": {"shape": "box", "size": [0.012, 0.2, 0.01]}, "position": [0.0, 0.0, 0.025]}
    cell = hand(scene({"pedestal": 0.03}, fixtures={"shelf": shelf}))
    cell.take_pedestal_away()
    let_pass(cell, 0.1)
    assert cell.object_pose().position[2] == pytest.approx(0.038, abs=50e-6)


def test_a_guided_object_slides_along_its_axis_and_resists() -> None:
    guide = {"axis": "y", "travel": 0.05, "friction": 1.0, "damping": 0.0}
    cell = gripped(hand(scene({"guide": guide})), 3.0)
    begin = cell.pose("hand")
    for number in range(1, 9):
        let_pass(cell, 0.05, {"hand": Pose(begin.position + [0, 1e-3 * number, 0], begin.quaternion)})
    assert cell.object_pose().position[1] == pytest.approx(8e-3, abs=1e-3)
    force = se3.rotate(cell.pose("hand"), cell.wrench("hand")[:3])
    assert force[1] == pytest.approx(-1.0, abs=0.02)


def test_a_cell_that_has_diverged_begins_again() -> None:
    cell = hand()
    state = cell.snapshot()
    cell.data.qvel[0] = np.nan
    with pytest.raises(SimulationDiverged, match="velocity not finite"):
        let_pass(cell, 0.05)
    cell.restore(state)
    let_pass(cell, 0.05)
    assert cell.object_pose().position == pytest.approx([0, 0, 0.038], abs=50e-6)


def test_a_state_of_something_else_is_refused() -> None:
    with pytest.raises(ValueError, match="'cell' is missing; is it of another world"):
        hand().restore({})


# ------------------------------------------------------------------- arms


def test_the_arm_has_the_kinematics_of_the_controller() -> None:
    cell = ur5e()
    joints = cell.arms["robot"].joints
    assert joints is not None
    frame = Kinematics("ur5e").forward(joints)
    flange = cell.data.body("robot/flange")
    assert flange.xpos - [-0.45, 0.0, 0.0] == pytest.approx(frame[:3, 3], abs=1e-12)
    assert flange.xmat.reshape(3, 3) == pytest.approx(frame[:3, :3], abs=1e-12)


def test_joints_that_would_turn_too_fast_are_refused() -> None:
    cell = ur5e()
    here = cell.pose("robot")
    turned = Pose(here.position, se3.compose(here, se3.from_rotation_vector(np.zeros(3), [0, 0, 0.4])).quaternion)
    with pytest.raises(LimitExceeded, match=r"joint 6 would turn with 8 rad/s, its greatest speed is 3.14 rad/s"):
        let_pass(cell, 0.05, {"robot": turned})


@pytest.mark.slow
def test_an_arm_lifts_an_object_and_hardly_gives_way() -> None:
    cell = gripped(ur5e(), 20.0, arm="robot")
    begin = cell.pose("robot")
    for number in range(1, 11):
        let_pass(cell, 0.05, {"robot": above(begin, 1e-3 * number)})
    let_pass(cell, 0.2)
    assert se3.pose_distance(cell.pose("robot"), above(begin, 0.01))[0] < 50e-6
    force = se3.rotate(cell.pose("robot"), cell.wrench("robot")[:3])
    assert np.linalg.norm(force - [0, 0, -WEIGHT]) < 2e-3 * WEIGHT
    assert cell.diagnostics({})["torque_limited_robot"] == 0.0


def test_a_pose_out_of_reach_is_refused() -> None:
    cell = ur5e()
    far = Pose(np.array([1.0, 0.0, 0.1]), se3.HALF_TURN_X.quaternion)
    with pytest.raises(LimitExceeded, match=r"tool at \(1, 0, 0.1\) m is out of reach"):
        let_pass(cell, 0.05, {"robot": far})

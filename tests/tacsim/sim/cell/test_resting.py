"""Cells whose object comes to rest in each period: the forces of a dynamic cell, without its time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from tacsim import pose as se3
from tacsim.control import NoTouch, ObjectDropped
from tacsim.interface import Pose
from tacsim.limits import LimitExceeded
from tacsim.models.scene import Scene
from tacsim.sim.cell.cell import Cell
from tacsim.sim.cell.description import FREE_HAND, ArmDescription
from tacsim.sim.cell.motion import DynamicMotion, RestingMotion
from tacsim.sim.cell.reset import open_around
from tacsim.sim.cell.resting import RestingCell
from tests.tacsim.sim.cell.cells import above, hand, scene

pytest.importorskip("mujoco")
SETTLED = RestingMotion(settle=True)


def resting(of: Scene | None = None, **gripper: Any) -> RestingCell:
    made = RestingCell(
        scene() if of is None else of, {"hand": ArmDescription()}, {"hand": replace(FREE_HAND, arm="hand", **gripper)}
    )
    open_around(made, "hand", "hand")
    return made


def held(force: float = 4.0, of: Scene | None = None) -> RestingCell:
    made = resting(of)
    SETTLED.grip(made, {"hand": "hand"}, force)
    return made


def weight_on(cell: Cell) -> float:
    """Of the object, carried by both pads [N]: their y axes point down."""
    return float(sum(cell.wrench(f"hand/{side}")[1] for side in ("left", "right")))


def test_the_pads_carry_the_weight_with_the_grip_that_was_asked() -> None:
    cell = held(4.0)
    assert weight_on(cell) == pytest.approx(0.981, rel=1e-3)
    assert [cell.normal_force(f"hand/{side}") for side in ("left", "right")] == pytest.approx([4.0, 4.0], rel=5e-3)
    assert cell.truth().forces == pytest.approx({"hand/left": 4.0, "hand/right": 4.0}, rel=5e-3)
    assert cell.slip_share("hand/left") == pytest.approx(0.4905 / (0.6 * 4.0), rel=0.02)
    assert not cell.has_pedestal


@pytest.mark.slow
def test_it_rests_where_a_dynamic_cell_does() -> None:
    lived = hand()
    open_around(lived, "hand", "hand")
    DynamicMotion().grip(lived, {"hand": "hand"}, 4.0)
    rested = held(4.0)
    assert rested.grippers["hand"].width == pytest.approx(lived.grippers["hand"].width, abs=10e-6)
    assert rested.slip_share("hand/left") == pytest.approx(lived.slip_share("hand/left"), rel=0.02)
    depths = [-cell.surface("hand/left").displacement[..., 2].min() for cell in (rested, lived)]
    assert depths[0] == pytest.approx(depths[1], rel=0.05)


def test_an_object_goes_where_the_hand_goes_and_slips_when_the_grip_loosens() -> None:
    cell = held(4.0)
    before = cell.object_pose()
    SETTLED.advance(cell, {"hand": above(cell.pose("hand"), 5e-3)}, 0.05)
    assert cell.object_pose().position - before.position == pytest.approx([0, 0, 5e-3], abs=5e-6)
    cell.grippers["hand"].command(0.0, 0.7)  # the least that holds is 0.8175 N
    for _ in range(5):
        RestingMotion(settle=False).advance(cell, {}, 0.05)
    assert cell.slip_share("hand/left") == pytest.approx(1.0, abs=0.03)
    assert cell.object_pose().position[2] < before.position[2] + 4.95e-3
    cell.grippers["hand"].command(0.03, 0.7)
    with pytest.raises(ObjectDropped, match=r"hold 0\.1 kg still with at least 0\.818 N each"):
        SETTLED.advance(cell, {}, 0.05)


def test_a_gripper_stops_at_a_width_and_opens_no_faster_than_it_may() -> None:
    cell = held(4.0)
    width = cell.grippers["hand"].width
    cell.grippers["hand"].command(width + 0.05e-3, 4.0)
    SETTLED.advance(cell, {}, 0.05)
    assert cell.grippers["hand"].width == pytest.approx(width + 0.05e-3, abs=1e-9)
    assert 0.5 < cell.normal_force("hand/left") < 4.0
    empty = resting(scene({"geometry": {"shape": "box", "size": [0.01, 0.01, 0.01]}}), speed=0.02)
    begin = empty.grippers["hand"].width
    empty.grippers["hand"].command(begin - 1e-3, 4.0)  # it does not meet the object
    SETTLED.advance(empty, {}, 0.01)
    assert empty.grippers["hand"].width == pytest.approx(begin - 0.4e-3, abs=1e-9)
    SETTLED.advance(empty, {}, 0.05)
    assert empty.grippers["hand"].width == pytest.approx(begin - 1e-3, abs=1e-9) and weight_on(empty) == 0.0


def test_a_restored_cell_goes_on_with_the_same_bits() -> None:
    cell = held(4.0)
    state = cell.snapshot()

    def go_on() -> bytes:
        cell.grippers["hand"].command(0.0, 2.5)
        RestingMotion(settle=False).advance(cell, {"hand": above(cell.pose("hand"), 1e-3)}, 0.05)
        return cell.data.qpos.tobytes() + cell.wrench("hand").tobytes()

    first = go_on()
    go_on()
    cell.restore(state)
    assert go_on() == first


def test_fixtures_are_refused() -> None:
    with pytest.raises(ValueError, match="no fixtures, and here are fixtures: use motion dynamic"):
        resting(scene(fixtures={"wall": {"position": [0, 0.1, 0.05]}}))


def test_a_guided_object_resists_slides_and_stops() -> None:
    guide = {"axis": "y", "travel": 5e-3, "friction": 1.0, "damping": 10.0}
    cell = held(3.0, scene({"guide": guide}))
    begin, flowing = cell.pose("hand"), RestingMotion(settle=False)

    def pull_to(way: float) -> float:
        """Returns the force of the object on the hand along world y."""
        flowing.advance(cell, {"hand": Pose(begin.position + [0, way, 0], begin.quaternion)}, 0.05)
        return float(se3.rotate(cell.pose("hand"), cell.wrench("hand")[:3])[1])

    forces = [pull_to(0.5e-3 * number) for number in range(1, 9)]
    assert forces[-3:] == pytest.approx([-1.1] * 3, rel=5e-3)  # 10 mm/s
    assert cell.truth().objects["object"].position[1] == pytest.approx(4e-3, abs=0.5e-3)
    assert weight_on(cell) == pytest.approx(0.0, abs=5e-3)
    state = cell.snapshot()
    for number in range(9, 14):
        force = pull_to(0.5e-3 * number)
    assert force < -2.0 and cell.object_pose().position[1] == pytest.approx(5e-3, abs=0.05e-3)
    cell.restore(state)
    cell.grippers["hand"].command(0.03, 3.0)
    flowing.advance(cell, {}, 0.05)
    assert not weight_on(cell)  # it lets go: the guide holds the object where it is
    assert cell.object_pose().position[1] == pytest.approx(float(state["qpos"][0]), abs=20e-6)


def test_a_grip_that_cannot_carry_is_refused() -> None:
    with pytest.raises(NoTouch, match=r"a grip of 0\.5 N cannot carry.*must be more than 0\.8175 N"):
        held(0.5)
    plate = scene({"geometry": {"shape": "box", "size": [0.02, 0.06, 0.016]}})
    with pytest.raises(LimitExceeded, match="housing"):
        held(20.0, plate)


def test_the_object_stands_on_its_pedestal_until_it_is_gripped() -> None:
    cell = resting()
    before = cell.object_pose()
    SETTLED.advance(cell, {"hand": Pose(cell.pose("hand").position, cell.pose("hand").quaternion)}, 0.05)
    assert cell.has_pedestal and cell.object_pose().position == pytest.approx(before.position, abs=0.2e-3)

"""Objects on a guide, which pads pull along: friction, slip in the grip, damper, stops."""

from __future__ import annotations

import numpy as np
import pytest

from tacsim.physics.grip.model import GuideSupport, HeldObject, HeldStates
from tacsim.physics.grip.world import GripWorld
from tests.tacsim.physics.grip.gripping import BOX, HOME, make_grip, pads_at, total_force

pytestmark = pytest.mark.cpu
FRICTION = 0.6  # of the handle


def pull(
    world: GripWorld, force: float, guide: GuideSupport, *, steps: int, way: float = 0.5e-3, begin: float = 0.0
) -> list[HeldStates]:
    """Steps of `way` along y with a grip force."""
    pose, found = HOME.copy(), []
    for number in range(1, steps + 1):
        pose[1] = begin + number * way
        found.append(world.step(pads_at(pose=pose), forces=[force], support=guide))
    return found


def gripped(force: float, guide: GuideSupport) -> GripWorld:
    world = make_grip(HeldObject(BOX, 0.2, FRICTION))
    states = world.grasp(pads_at(), [force], guide=guide)
    assert np.abs(total_force(states)).max() < 5e-3  # the guide carries the weight
    return world


@pytest.mark.parametrize("way", [0.1e-3, 0.5e-3])
@pytest.mark.parametrize("excess", [1.04, 4.0])
def test_a_drawer_follows_with_the_friction_of_its_guide(excess: float, way: float) -> None:
    guide = GuideSupport(axis=1, friction=1.5)
    force = excess * 1.5 / (2 * FRICTION)
    ends = pull(gripped(force, guide), force, guide, steps=14, way=way)
    assert [-total_force(each)[1] for each in ends[-4:]] == pytest.approx([1.5] * 4, rel=2e-3)
    assert np.diff([each.objects[0, 1] for each in ends[-5:]]) == pytest.approx([way] * 4, rel=2e-3)
    assert ends[-1].slip_shares[0] == pytest.approx(1 / excess, abs=5e-3)
    aside = ends[-1].objects[0, [0, 2]]
    assert np.abs(aside).max() < 25e-6 and np.abs(ends[-1].objects[0, 3:6]).max() < 1e-4


def test_pads_slide_along_the_handle_where_friction_is_less_than_the_guides() -> None:
    guide = GuideSupport(axis=1, friction=1.5)
    ends = pull(gripped(1.1, guide), 1.1, guide, steps=14)
    assert np.ptp([each.objects[0, 1] for each in ends]) < 10e-6
    forces = [-total_force(each)[1] for each in ends[2:]]
    assert float(np.mean(forces)) == pytest.approx(2 * FRICTION * 1.1, rel=0.04)
    assert max(forces) < 1.02 * 2 * FRICTION * 1.1


def test_a_damper_resists_by_the_way_of_a_step() -> None:
    guide = GuideSupport(axis=1, friction=1.0, drag=1000.0)  # 0.5 N at 0.5 mm
    world = gripped(6.0, guide)
    ends = pull(world, 6.0, guide, steps=10)
    assert -total_force(ends[-1])[1] == pytest.approx(1.5, rel=5e-3)
    stopped = pull(world, 6.0, guide, steps=1, way=0.0, begin=5e-3)
    assert -total_force(stopped[-1])[1] == pytest.approx(1.0, rel=1e-2)


def test_a_guide_ends_at_its_stops_whichever_way_it_is_pushed() -> None:
    world = gripped(6.0, GuideSupport(axis=1, friction=0.2))
    for sign, stop in ((1.0, 1.2e-3), (-1.0, -0.3e-3)):
        pose = HOME.copy()
        for number in range(1, 7):
            pose[1] = sign * 0.4e-3 * number
            at = float(world.states.objects[0, 1])
            guide = GuideSupport(1, 0.2, room=(-0.3e-3 - at, 1.2e-3 - at))
            states = world.step(pads_at(pose=pose), forces=[6.0], support=guide)
        assert states.objects[0, 1] == pytest.approx(stop, abs=80e-6)
        assert -sign * total_force(states)[1] > 3.0  # it holds the object against the pads


def test_a_drawer_has_no_momentum() -> None:
    guide = GuideSupport(axis=1, friction=0.3)
    world = gripped(6.0, guide)
    end = pull(world, 6.0, guide, steps=10)[-1]
    stopped = pull(world, 6.0, guide, steps=3, way=0.0, begin=5e-3)[-1]
    assert stopped.objects[0, 1] == pytest.approx(end.objects[0, 1], abs=2e-6)
    kept = world.snapshot(0)
    first = pull(world, 6.0, guide, steps=2, begin=5e-3)[-1]
    world.restore(0, kept)
    again = pull(world, 6.0, guide, steps=2, begin=5e-3)[-1]
    assert np.array_equal(first.wrenches, again.wrenches) and np.array_equal(first.objects, again.objects)


@pytest.mark.parametrize(
    ("guide", "message"),
    [
        (GuideSupport(3), "the axis of a guide is 0, 1 or 2"),
        (GuideSupport(1, friction=-1.0), "neither its friction nor its drag is negative"),
        (GuideSupport(1, friction=[1.0, 2.0]), "a guide needs an axis, a friction and a drag of one number"),
        (GuideSupport(1, room=(0.2, 0.1)), "ends before it begins"),
    ],
)
def test_what_is_no_guide_is_refused(guide: GuideSupport, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        guide.rows(1)

"""Many grips in one launch: bits, state, failures, refusals."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tacsim.models.material import GelMaterial
from tacsim.models.scene import Box, Cylinder, Gel, Sphere
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.grip.model import GripCommand, HeldObject, HeldStates, Support
from tacsim.physics.grip.world import GripWorld
from tests.tacsim.physics.grip.gripping import BALL, BOX, HOME, held, make_grip, pads_at

pytestmark = pytest.mark.cpu

ITEMS = (
    HeldObject(BOX, 0.1),
    HeldObject(BALL, 0.02, friction=1.0),
    HeldObject(Box(size=(20e-3, 14e-3, 14e-3)), 0.3, 0.4),
)
GELS = tuple(Gel(material=GelMaterial(youngs_modulus=modulus), housing=None) for modulus in (0.145e6, 0.3e6, 0.1e6))


def wander(world: GripWorld, which: list[int], steps: int = 12) -> list[HeldStates]:
    """Steps that close, lift, turn, load and open, each grip in its own way."""
    found = [world.grasp(pads_at(count=len(which)), [(3.0, 3.0, 8.0)[index] for index in which])]
    for number in range(steps):
        pads, forces, loads = [], [], []
        for index in which:
            random = np.random.default_rng(100 * index + number)
            turn = Rotation.from_rotvec(random.uniform(-0.02, 0.02, 3)).as_quat()
            pose = np.array([*random.uniform(-1e-3, 1e-3, 3), *turn])
            pads.append(pads_at(-0.4e-3 - 0.03e-3 * number, pose=pose)[0])
            forces.append(random.uniform(5.0, 8.0) if (number + index) % 3 else np.nan)
            loads.append(random.uniform(-0.2, 0.2, 6) * [1, 1, 1, 1e-3, 1e-3, 1e-3])
        support = Support([20.0] * 3 + [0.0] * 3)
        found.append(
            world.step(np.array(pads), forces=forces, loads=np.array(loads), support=support, settle=number == 7)
        )
    return found


def same(a: HeldStates, b: HeldStates, index: int, other: int) -> bool:
    """Whether all numbers of two grips are equal, bit for bit."""
    return all(
        np.array_equal(getattr(a, name)[index], getattr(b, name)[other]) for name in HeldStates.__dataclass_fields__
    )


def test_a_grip_in_a_batch_has_the_bits_that_it_has_alone() -> None:
    together = GripWorld(ITEMS, GELS)
    together.reset(np.tile(HOME, (3, 1)), pads_at(count=3))
    found = wander(together, [0, 1, 2])
    assert found[-1].wrenches.shape == (3, 2, 6)
    assert found[-1].touching.all()
    for index in range(3):
        alone = GripWorld([ITEMS[index]], GELS[index])
        alone.reset(HOME[None], pads_at())
        for ours, theirs in zip(wander(alone, [index]), found, strict=True):
            assert same(ours, theirs, 0, index)
        assert np.array_equal(alone.surface(0, 1).displacement, together.surface(index, 1).displacement)


def test_a_restored_grip_continues_with_the_same_bits_and_the_others_as_they_were() -> None:
    world = GripWorld(ITEMS, GELS)
    world.reset(np.tile(HOME, (3, 1)), pads_at(count=3))
    wander(world, [0, 1, 2], 5)
    kept = [world.snapshot(index) for index in range(3)]
    first = wander(world, [0, 1, 2])
    for index in range(3):
        world.restore(index, kept[index])
    assert same(world.states, world.states, 0, 0)
    second = wander(world, [0, 1, 2])
    assert all(same(a, b, index, index) for a, b in zip(first, second, strict=True) for index in range(3))
    world.reset(HOME, pads_at()[0], 1)
    assert list(world.states.touching.any(axis=1)) == [True, False, True]
    with pytest.raises(ValueError, match="snapshot: 'gel_displacement_0' must have shape"):
        world.restore(0, {"object": np.zeros((1, 7))})


def test_a_replaced_grip_is_a_new_one_and_the_others_stay_as_they_were() -> None:
    world = GripWorld(ITEMS, GELS)
    world.reset(np.tile(HOME, (3, 1)), pads_at(count=3))
    wander(world, [0, 1, 2], 4)
    kept = [world.snapshot(index) for index in (0, 2)]
    tilted = (0.5, 0.0, -9.0)
    world.replace(1, ITEMS[2], GELS[0], tilted)
    with pytest.raises(ValueError, match="grip 1 has no object in place yet"):
        world.step(pads_at(count=3))
    world.reset(HOME, pads_at()[0], 1)
    new = GripWorld(ITEMS[2:], GELS[0], gravity=tilted)
    new.reset(HOME[None], pads_at())
    grasped = world.grasp(pads_at(), [8.0], 1), new.grasp(pads_at(), [8.0])
    assert same(*grasped, 0, 0)
    for number in range(3):
        up = HOME + [0, 0, 1e-3 * number, 0, 0, 0, 0]
        command = GripCommand(pads_at(pose=up)[0], 6.0 - number)
        found, wanted = world.step_each({1: command})[1], new.step_each({0: command})[0]
        assert isinstance(found, HeldStates)
        assert isinstance(wanted, HeldStates)
        assert same(found, wanted, 0, 0)
    assert np.array_equal(world.surface(1, 0).displacement, new.surface(0, 0).displacement)
    for index, state in zip((0, 2), kept, strict=True):
        assert all(np.array_equal(state[name], array) for name, array in world.snapshot(index).items())
    with pytest.raises(ValueError, match="environments of a batch need one gel lattice"):
        world.replace(1, ITEMS[0], Gel(size=(16e-3, 20e-3, 4e-3)))
    assert world.step_each({1: command})[1].touching.all()  # type: ignore[union-attr]


def test_some_grips_step_and_one_that_fails_stays_alone() -> None:
    world, other = (GripWorld(ITEMS, GELS) for _ in range(2))
    for each in (world, other):
        each.reset(np.tile(HOME, (3, 1)), pads_at(count=3))
        each.grasp(pads_at(count=3), [3.0, 3.0, 8.0])
    good = {index: GripCommand(pads_at(-0.05e-3)[0], 5.0) for index in (0, 1)}
    wanted = other.step_each(good)
    kept = world.snapshot(2)
    crushed = GripCommand(pads_at(-6e-3)[0])
    far = GripCommand(one_pad_far_away()[0])
    found = world.step_each({**good, 2: crushed})
    assert isinstance(found[2], SimulationDiverged)
    assert found[2].environment == 2
    for index in (0, 1):
        assert same(found[index], wanted[index], 0, 0)  # type: ignore[arg-type]
    assert all(np.array_equal(kept[name], array) for name, array in world.snapshot(2).items())
    found, wanted = world.step_each({**good, 2: far}), other.step_each(good)
    assert "take more steps" in str(found[2])
    assert same(found[0], wanted[0], 0, 0)  # type: ignore[arg-type]
    assert all(np.array_equal(kept[name], array) for name, array in world.snapshot(2).items())
    assert same(world.states, other.states, 1, 1)


def test_a_step_that_settles_ends_when_forces_balance_and_another_has_a_fixed_length() -> None:
    world = make_grip(*ITEMS[:2])
    world.grasp(pads_at(count=2), [3.0, 5.0])
    settled = world.step(pads_at(count=2), forces=[3.0, 5.0], settle=True)
    assert settled.at_rest.all() and (settled.substeps < 60).all()
    pushed = world.step(pads_at(count=2), forces=[3.5, 5.0], settle=True)
    assert pushed.substeps[0] > pushed.substeps[1] and pushed.at_rest.all()
    fixed = world.step(pads_at(count=2), forces=[3.0, 5.0])
    assert (fixed.substeps == world.substeps).all() and not fixed.at_rest[0]


def test_an_unphysical_state_is_rolled_back_and_says_what_to_do() -> None:
    world = make_grip(*ITEMS[:2])
    world.grasp(pads_at(count=2), [3.0, 3.0])
    before = [world.snapshot(index) for index in range(2)]
    pads = pads_at(count=2)
    pads[1] = pads_at(-6e-3)[0]
    with pytest.raises(SimulationDiverged, match=r"(?s)grip 1 in step .*move less far") as caught:
        world.step(pads)
    assert caught.value.environment == 1
    for index in range(2):
        now = world.snapshot(index)
        assert all(np.array_equal(now[name], array) for name, array in before[index].items())
    assert world.step(pads_at(count=2), forces=[3.0, 3.0]).touching.all()


def one_pad_far_away() -> np.ndarray:
    pads = pads_at()
    pads[0, 0, 1] += 0.2
    return pads


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda w: w.step(pads_at()[0]), r"pads must have shape \(1, 2, 7\)"),
        (lambda w: w.step(np.full((1, 2, 7), np.nan)), "finite numbers, and a quaternion"),
        (lambda w: w.step(2 * pads_at()), r"a quaternion .* of length 1"),
        (lambda w: w.step(pads_at(), forces=[-1.0]), r"forces must have shape .* not negative"),
        (lambda w: w.step(pads_at(), forces=[1.0, 2.0]), "forces must have shape"),
        (lambda w: w.step(pads_at(), loads=np.full((1, 6), np.inf)), "loads must be finite numbers"),
        (lambda w: w.step(pads_at(), support=Support([1.0] * 5)), "a support needs a stiffness"),
        (lambda w: w.step(pads_at(), support=Support([-1.0] * 6)), "none of its numbers negative"),
        (lambda w: w.step(one_pad_far_away()), "take more steps"),
        (lambda w: w.reset(HOME[None], pads_at(-0.5e-3)), r"0\.5 mm inside its gel"),
        (lambda w: w.reset(HOME, pads_at()), r"objects must have shape \(1, 7\)"),
    ],
)
def test_wrong_arguments_are_refused_and_nothing_moves(call: Callable[[GripWorld], object], message: str) -> None:
    world, _ = held(gravity=(0.0, 0.0, 0.0))
    before = world.snapshot(0)
    with pytest.raises(ValueError, match=message):
        call(world)
    assert all(np.array_equal(array, before[name]) for name, array in world.snapshot(0).items())


def test_grips_that_cannot_be_made_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one object"):
        GripWorld([])
    with pytest.raises(ValueError, match="3 objects, 2 pads, 2 gels"):
        GripWorld(ITEMS, GELS[:2])
    with pytest.raises(ValueError, match="environments of a batch need one gel lattice"):
        GripWorld(ITEMS[:2], [Gel(), Gel(size=(16e-3, 20e-3, 4e-3))])
    with pytest.raises(ValueError, match="fits between the gel's contact points"):
        GripWorld([HeldObject(Cylinder(radius=0.3e-3, height=20e-3), 0.01)])
    with pytest.raises(ValueError, match="gravity must be finite"):
        GripWorld(ITEMS[:1], gravity=[0, 0, np.nan])
    with pytest.raises(ValueError, match="substeps is 1; give at least 2"):
        GripWorld(ITEMS[:1], substeps=1)
    with pytest.raises(ValueError, match="call reset"):
        GripWorld(ITEMS[:1]).step(pads_at())
    with pytest.raises(TypeError, match=r"restore\(world\.snapshot"):
        __import__("copy").copy(make_grip(ITEMS[0]))


def test_three_pads_hold_a_ball() -> None:
    world = GripWorld([HeldObject(Sphere(radius=10e-3), 0.05)], Gel(housing=None), pads=3)
    pads = np.empty((1, 3, 7))
    for number in range(3):
        around = Rotation.from_euler("z", 120 * number, degrees=True)
        pads[0, number, :3] = around.apply([-10.2e-3, 0.0, 0.0])
        pads[0, number, 3:] = (around * Rotation.from_euler("y", 90, degrees=True)).as_quat()
    world.reset(HOME[None], pads)
    states = world.grasp(pads, [2.0])
    assert states.at_rest.all() and states.touching.all()
    assert -states.wrenches[0, :, 2] == pytest.approx([2.0] * 3, rel=0.01)
    assert held()[1].touching.all()

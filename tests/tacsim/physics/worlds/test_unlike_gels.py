"""A scene whose two gels differ in size, thickness, material and mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tacsim.interface import Pose
from tacsim.models.scene import Scene
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.move import MoveStats
from tacsim.physics.world import World, make_world
from tacsim.physics.worlds.batch import Batch

THICK = {"size": [10e-3, 8e-3, 4e-3], "element_size": 1e-3, "housing": None}
THIN = {"size": [7e-3, 9e-3, 2e-3], "element_size": 0.5e-3, "material": {"youngs_modulus": 0.4e6, "density": 1300.0}}
HALF_TURN = np.array([1.0, -1.0, -1.0])  # about x: what it makes of a vector in the world
CLAY = {"youngs_modulus": 0.5e6, "yield_stress": 3e4}


def scene(gels: dict[str, Any], **more: Any) -> Scene:
    body = {"geometry": {"shape": "box", "size": [4e-3, 4e-3, 3e-3]}, "material": {"youngs_modulus": 1e6}}
    return Scene.model_validate({"preset": "draft", "body": body, "gels": gels, **more})


def moved(world: World, name: str, by: Any) -> dict[str, Pose]:
    """A sensor `by` (3,) [m] from where it is."""
    pose = world.pose(name)
    return {name: Pose(pose.position + np.asarray(by), pose.quaternion)}


def force(world: World, name: str) -> float:
    """Normal force [N], positive when pressed."""
    return -float(world.wrench(name)[2])


@pytest.mark.parametrize(("material", "rounding"), [({"youngs_modulus": 1e6}, 6e-4), (CLAY, 1e-2)])
def test_swapped_gels_give_mirrored_forces(material: dict[str, float], rounding: float) -> None:
    """The scene turned by half a turn about x has the other gel below.

    `rounding`: difference of surfaces, of the largest displacement: three times the change by commands that differ by
    0.1 to 0.3 nm (up to 2e-4, and 3.6e-3 if the body yields)."""
    body = {"geometry": {"shape": "box", "size": [4e-3, 4e-3, 3e-3]}, "material": material}
    friction = {"lower": 0.4, "upper": 0.8}
    # A hold of one length: where it ends at a tolerance, rounding may end one of the two a reading later.
    more: dict[str, Any] = {"body": body, "settling": {"tolerance": 1e-9, "max_substeps": 80, "mach": 0.0313}}
    one = make_world(scene({"lower": THICK, "upper": THIN}, friction=friction, **more))
    other = make_world(scene({"lower": THIN, "upper": THICK}, friction={"lower": 0.8, "upper": 0.4}, **more))
    for by in ([0.0, 0.0, -0.5e-3], [0.1e-3, 0.05e-3, 0.0]):
        first = one.move(moved(one, "upper", by))
        second = other.move(moved(other, "lower", HALF_TURN * by))
        assert first.substeps == second.substeps and max(first.residual, second.residual) < 1e-2
    largest = np.abs(one.wrench("upper")[:3]).max()
    assert largest > 0.05
    for name, mirrored in (("lower", "upper"), ("upper", "lower")):
        assert one.wrench(name)[:3] == pytest.approx(other.wrench(mirrored)[:3], abs=2e-4 * largest)
        a, b = one.surface(name), other.surface(mirrored)
        assert (a.spacing, a.origin, a.displacement.shape) == (b.spacing, b.origin, b.displacement.shape)
        assert np.abs(a.displacement - b.displacement).max() < rounding * np.abs(a.displacement).max()


@pytest.mark.parametrize("name", ["lower", "upper"])
def test_gels_oscillate_at_quarter_wave_frequency_in_real_time(name: str) -> None:
    """Of a wide layer bonded at its back: period 4 H / c_s, by its own thickness, modulus and density."""
    gels = {
        "lower": {"size": [36e-3, 36e-3, 4e-3], "material": {"poisson_ratio": 0.3, "density": 1200.0}},
        "upper": {
            "size": [14e-3, 12e-3, 2e-3], "element_size": 0.5e-3,
            "material": {"youngs_modulus": 0.5e6, "poisson_ratio": 0.2, "density": 900.0},
        },
    }  # fmt: skip
    world = make_world(scene(gels))
    world.place(moved(world, "upper", [0.0, 0.0, 20e-3]))
    state, amplitude = dict(world.snapshot()), 5e-6  # [m]
    for sensor in gels:
        shape = np.zeros_like(state[f"gel_displacement_{sensor}"])
        shape[..., 0] = 1e3 * amplitude * np.sin(np.linspace(0, np.pi / 2, shape.shape[-2]))
        state[f"gel_displacement_{sensor}"] = shape
    world.restore(state)
    gel = world.scene.gel_of(name)  # type: ignore[attr-defined]
    shear = gel.material.youngs_modulus / (2 * (1 + gel.material.poisson_ratio))
    world.move({}, duration=2 * gel.size[2] / np.sqrt(shear / gel.material.density))
    top = world.surface(name).displacement[..., 0]
    assert top[top.shape[0] // 2, top.shape[1] // 2] == pytest.approx(-amplitude, rel=0.03)


def test_dents_of_stiff_and_soft_gel_scale_with_moduli() -> None:
    """In series under a nearly rigid body: one force, and four times the dent in what is a fourth as stiff."""
    stiff = {"material": {"youngs_modulus": 0.58e6}}
    body = {"geometry": {"shape": "box", "size": [4e-3, 4e-3, 3e-3]}, "material": {"youngs_modulus": 50e6}}
    common = {"body": body, "friction": {"lower": 0.0, "upper": 0.0}, "gel": {"size": [10e-3, 10e-3, 4e-3]}}
    world = make_world(scene({"upper": stiff}, **common))
    assert world.move(moved(world, "upper", [0.0, 0.0, -0.4e-3])).settled
    assert force(world, "upper") == pytest.approx(force(world, "lower"), rel=0.01) and force(world, "lower") > 0.1
    middle = (5, 5)  # of 11 x 11 nodes
    soft_dent, stiff_dent = (-float(world.surface(name).displacement[(*middle, 2)]) for name in ("lower", "upper"))
    assert soft_dent / stiff_dent == pytest.approx(4.0, rel=0.02)
    # the soft gel answers as between two soft ones that are closed by twice its own share
    alike = make_world(scene({}, **common))
    alike.move(moved(alike, "upper", [0.0, 0.0, -0.2e-3 - 2 * soft_dent]))
    assert force(alike, "lower") == pytest.approx(force(world, "lower"), rel=0.02)


def test_equal_gels_give_same_bits_for_both_configurations() -> None:
    gel = {"size": [8e-3, 8e-3, 2e-3], "housing": 0.2e-3, "material": {"youngs_modulus": 0.2e6}}
    scenes = [
        scene({}, gel=gel),
        scene({"lower": gel, "upper": gel}),
        scene({"upper": {"housing": 0.2e-3}}, gel=gel),
    ]
    worlds = [make_world(each) for each in scenes]
    ends = [world.move(moved(world, "upper", [0.05e-3, 0.0, -0.4e-3])) for world in worlds]
    assert ends[1] == ends[0] and ends[2] == ends[0]
    states = [world.snapshot() for world in worlds]
    for state in states[1:]:
        assert state.keys() == states[0].keys()
        assert all(np.array_equal(state[name], states[0][name]) for name in state)
    worlds[2].restore(states[0])


def test_worlds_of_a_batch_end_as_alone_and_share_the_lattice_of_each_sensor() -> None:
    gels = {"lower": THICK, "upper": THIN}
    softer = {"lower": {**THICK, "material": {"youngs_modulus": 0.1e6}}, "upper": THIN}
    scenes = [scene(gels), scene(softer)]
    batch, alone = Batch(scenes), [make_world(each) for each in scenes]
    commands = [moved(world, "upper", [0.0, 0.0, -0.45e-3]) for world in alone]
    ends = batch.move(commands)
    assert isinstance(ends[0], MoveStats)
    for together, world, command, end in zip(batch.worlds, alone, commands, ends, strict=True):
        assert world.move(command) == end
        state = world.snapshot()
        assert all(np.array_equal(each, state[name]) for name, each in together.snapshot().items())
    batch.replace(0, scenes[1])
    assert batch.move([commands[1], None])[0] == ends[1]
    with pytest.raises(ValueError, match=r"environment 1 has 20 x 18 x 4 elements of 0\.5 mm.*\(sensor 'upper'\)"):
        Batch([scene(gels), scene({"lower": THICK, "upper": {**THIN, "size": [10e-3, 9e-3, 2e-3]}})])


def test_a_load_is_held_by_either_gel() -> None:
    world = make_world(scene({"lower": THICK, "upper": THIN}))
    world.move(moved(world, "upper", [0.0, 0.0, -0.3e-3]))
    for name, load in (("upper", 0.2), ("lower", 0.3)):
        assert world.move({}, {name: load}).settled
        assert force(world, name) == pytest.approx(load, rel=0.011)


def test_fault_is_located_in_its_gel() -> None:
    world = make_world(scene({"lower": THICK, "upper": THIN}))
    arrays = world.arrays()  # type: ignore[attr-defined]
    arrays["gel_displacement_upper"][0, 3, 4, -1, 2] = np.nan
    place = r"node \[3, 4, 4\] of the upper gel, \(-2\.000, -2\.500, 0\.000\) mm"
    with pytest.raises(SimulationDiverged, match=rf"gel_displacement_upper\[0, 3, 4, 4, 2\] is nan.*{place}"):
        world.move(moved(world, "upper", [0.0, 0.0, -0.2e-3]))


def test_gels_that_meet_are_refused_by_the_thinner_one() -> None:
    world = make_world(scene({"lower": {**THICK, "size": [16e-3, 8e-3, 4e-3]}, "upper": THIN}))
    beside = moved(world, "upper", [7.8e-3, 0.0, 0.0])
    world.place(beside)
    down = moved(world, "upper", [0.0, 0.0, -3.9e-3])
    with pytest.raises(SimulationDiverged, match=r"the gels overlap by .* mm.*limit 0\.5 mm"):
        world.move(down)

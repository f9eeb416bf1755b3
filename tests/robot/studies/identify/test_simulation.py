"""The laws that spare simulations, and what a recording is reduced to."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.materials.fit import (
    Noise,
    Parameter,
    Point,
    Press,
    downsample_press,
    merge_repeated_readings,
    signals_of,
)
from robot.studies.identify.identify import parameters_of
from robot.studies.identify.simulation import Simulation, coarser, scene_with
from tacsim.config import load_scene
from tacsim.interface import Pose
from tacsim.pose import HALF_TURN_X

STIFFNESS = Parameter("youngs_modulus", 0.145e6, 1e3, 1e9)


def pressed(places: list[tuple[float, float]], part: str = "indenter", up: float = 4e-3) -> Press:
    """A press through these places (x, height of the lowest point) [mm]."""
    turned = HALF_TURN_X.quaternion if part == "upper" else Pose().quaternion
    poses = {part: tuple(Pose(np.array([x * 1e-3, 0.0, up + z * 1e-3]), turned) for x, z in places)}
    if part == "upper":
        poses["lower"] = (Pose(),) * len(places)
    count = len(places)
    readings = {f"lower.{name}": np.zeros(count) for name in ("fx", "fz")}
    return Press("press", poses, readings, np.arange(count, dtype=float), np.ones(count, np.int64))


def test_forces_of_a_rigid_press_are_proportional_to_stiffness() -> None:
    """Quasi-statics of a neo-Hookean gel with Coulomb friction: exact but for what settling leaves."""
    press = pressed([(0, 0.1), (0, -0.5), (0.5, -0.5)])
    scene = load_scene("press", ["preset=learn"])
    point = Point(np.array([STIFFNESS.free(0.37e6)]), np.zeros(1))
    scaled = Simulation(scene, (STIFFNESS,), (press,), {})([point])[0]
    run = Simulation(scene_with(scene, {"youngs_modulus": 0.37e6}), (), (press,), {})
    [direct] = run([Point(np.zeros(0), np.zeros(1))])
    assert scaled == pytest.approx(direct, rel=1e-3, abs=1e-4) and abs(direct[4]) > 0.1


def test_forces_of_a_squeeze_are_homogeneous_in_moduli_and_stresses() -> None:
    """So the influence of the gels' stiffness on a body's fit needs no simulation of its own."""
    press = pressed([(0, 0.2), (0, -0.6), (0, -1.6), (0.6, -1.6)], "upper", 10e-3)
    scene = load_scene("squeeze", ["preset=learn"])
    assert scene.body is not None
    gel, body = scene.gel.material, scene.body.material
    stiffer = scene_with(
        scene, {"youngs_modulus": 2 * body.youngs_modulus, "yield_stress": 2 * body.yield_stress}
    )  # fmt: skip
    stiffer = stiffer.model_copy(
        update={
            "gel": stiffer.gel.model_copy(
                update={"material": gel.model_copy(update={"youngs_modulus": 2 * gel.youngs_modulus})}
            )
        }
    )
    first, second = (
        Simulation(each, (), (press,), {})([Point(np.zeros(0), np.zeros(1))])[0] for each in (scene, stiffer)
    )
    assert second == pytest.approx(2 * first, rel=1e-3, abs=1e-3) and abs(first[6]) > 1.0


def test_a_place_moves_the_parts_nearer() -> None:
    press = pressed([(0, 0.1), (0, -0.5)])
    deeper = pressed([(0, 0.05), (0, -0.55)])
    simulation = Simulation(load_scene("press", ["preset=learn"]), (STIFFNESS,), (press,), {})
    free = np.array([STIFFNESS.free(STIFFNESS.start)])
    [moved] = simulation([Point(free, np.array([0.05e-3]))])
    [direct] = Simulation(simulation.scene, (STIFFNESS,), (deeper,), {})([Point(free, np.zeros(1))])
    assert moved == pytest.approx(direct, rel=1e-5)


def test_readings_in_one_place_become_their_mean() -> None:
    press = pressed([(0, 0.1), (0, -0.1), (0, -0.1), (0, -0.1), (0, -0.2)])
    press.readings["lower.fz"][:] = [0, 1, 2, 6, 9]
    result = merge_repeated_readings(press)
    assert result.readings["lower.fz"].tolist() == [0, 3, 9] and result.repeats.tolist() == [1, 3, 1]
    assert signals_of([result], Noise(force=0.3)).noise[4] == pytest.approx(0.3 / np.sqrt(3))


def test_a_thinned_path_keeps_its_turns() -> None:
    down = [(0.0, 0.1 - 0.02 * k) for k in range(40)]
    aside = [(0.05 * k, down[-1][1]) for k in range(1, 40)]
    places = downsample_press(pressed(down + aside), 8).places
    assert len(places) <= 11
    for turn in (down[0], down[-1], aside[-1]):
        assert np.abs(places[:, [0, 2]] * 1e3 - [turn[0], 4 + turn[1]]).sum(axis=1).min() < 1e-9


def test_what_a_scene_thinks_is_where_a_fit_begins() -> None:
    scene = load_scene("squeeze", ["preset=draft", "body.material.yield_norm=frobenius"])
    found = {each.name: each.start for each in parameters_of("body", scene)}
    assert found["yield_stress"] == pytest.approx(30e3 * np.sqrt(1.5))
    assert scene_with(scene, found).body.material.elastic_limit == pytest.approx(scene.body.material.elastic_limit)
    assert coarser(scene).effective_element_size == 2e-3 and coarser(coarser(scene)).effective_element_size == 2e-3

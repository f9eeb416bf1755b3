"""The tilted slide tells both frictions: its own pieces of path, on the smallest worlds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.identify import planned
from calibration.materials.fit import Point
from robot.studies.identify.identify import parameters_of
from robot.studies.identify.motions import motions
from robot.studies.identify.simulation import Simulation
from tacsim.config import load_scene


def test_on_the_way_back_the_tilted_gel_moves_along_its_own_face() -> None:
    rows = np.loadtxt(motions(load_scene("squeeze"))["tilt"].splitlines(), delimiter=",", skiprows=1)
    back = np.flatnonzero(np.diff(rows[:, 0]) < 0)
    steps = np.diff(rows, axis=0)[back]
    assert steps[:, 1] == pytest.approx(-steps[:, 0] * math.tan(rows[:, 2].max()), rel=1e-3) and len(back) > 4


@pytest.mark.slow
def test_a_body_is_left_on_its_gel_and_feels_the_same_in_fewer_steps() -> None:
    """An edge that turned into the body threw it off the lower gel, and how far depended on the steps: forces were up
    to 60 % off."""
    scene = load_scene("squeeze", ["preset=learn"])
    few, every = (planned(scene, "tilt", moments) for moments in (24, 1000))
    forces = [Simulation(scene, (), (press,), {})([Point(np.zeros(0), np.zeros(1))])[0] for press in (few, every)]
    alike = forces[1].reshape(4, -1)[:, np.isin(every.time, few.time)]
    assert len(few.time) < 0.6 * len(every.time)
    assert np.abs(forces[0].reshape(4, -1) - alike).max() < 0.02 * np.abs(alike).max()


@pytest.mark.deep
def test_between_tilted_gels_both_slip() -> None:
    """Coulomb: the sideways force of a gel that slips is its friction times the normal force, so the largest share of a
    path is the friction, as far as the dent that it slips in is level. The angles of friction differ by 14 and 12
    degrees: between gels tilted by 8 the one with more friction sticks (a share 21 to 52 % below it)."""
    scene = load_scene("squeeze", ["preset=learn"])
    frictions = ({"lower": 0.3, "upper": 0.6}, {"lower": 0.55, "upper": 0.3})
    points = [Point(np.log([each["lower"], each["upper"]]), np.zeros(1)) for each in frictions]
    simulated = Simulation(scene, parameters_of("body", scene)[3:], (planned(scene, "tilt", 12),), {})(points)
    for each, signals in zip(frictions, simulated, strict=True):
        lower_x, lower_z, upper_x, upper_z = signals.reshape(4, -1)
        for gel, aside, down in (("lower", lower_x, lower_z), ("upper", upper_x, upper_z)):
            felt = np.abs(down) > 0.5
            assert np.abs(aside[felt] / down[felt]).max() == pytest.approx(each[gel], rel=0.15)

"""A body whose truth is simulated on another mesh; a zero that drifts is noticed for it as for a gel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.materials.fit import Noise, Point, Press, Priors
from robot.studies.identify.identify import Identified, identify
from robot.studies.identify.recordings import Recordings
from robot.studies.identify.simulation import Simulation
from tacsim.config import load_scene
from tacsim.interface import Pose
from tacsim.pose import HALF_TURN_X

GAPS = np.array([10.3, 10.2, 9.6, 9.2, 8.8, 8.4, 8.0, 8.4, 7.6, 7.2, 10.3]) * 1e-3
TRUTH = {"youngs_modulus": 420e3, "yield_stress": 36e3}
NOISE, PRIORS = Noise(force=0.05), Priors(0.02e-3, 0.2)


@pytest.fixture(scope="module")
def squeeze() -> Press:
    count = len(GAPS)
    poses = {
        "lower": (Pose(),) * count,
        "upper": tuple(Pose(np.array([0.0, 0.0, gap]), HALF_TURN_X.quaternion) for gap in GAPS),
    }
    readings = {"lower.fz": np.zeros(count), "upper.fz": np.zeros(count)}
    press = Press("squeeze", poses, readings, np.arange(count, dtype=float), np.ones(count, np.int64))
    material = [f"body.material.{name}={value}" for name, value in TRUTH.items()]
    true = load_scene("squeeze", ["preset=learn", "particle_spacing=0.8 mm", *material])
    [signals] = Simulation(true, (), (press,), {})([Point(np.zeros(0), np.zeros(1))])
    noise = np.random.default_rng(0).normal(0, NOISE.force, 2 * count)
    lower, upper = (signals + noise).reshape(2, count)
    return replace(press, readings={"lower.fz": lower, "upper.fz": upper})


def found(press: Press) -> Identified:
    scene = load_scene("squeeze", ["preset=learn"])
    return identify("body", scene, Recordings(scene), [press], NOISE, PRIORS, wanted=list(TRUTH))


@pytest.mark.slow
def test_stiffness_and_yield_of_a_body_in_some_tens_of_squeezes(squeeze: Press) -> None:
    result = found(squeeze)
    for name, truth in TRUTH.items():
        low, high = result.fit.interval(name)
        assert low < truth < high and result.fit.value(name) == pytest.approx(truth, rel=0.1)
    assert result.findings == () and result.fit.runs < 30


@pytest.mark.slow
def test_a_zero_that_drifts_during_a_squeeze_is_noticed(squeeze: Press) -> None:
    drifting = squeeze.readings["lower.fz"] + 1.0 * np.linspace(0, 1, len(GAPS))
    result = found(replace(squeeze, readings=squeeze.readings | {"lower.fz": drifting}))
    assert [each.kind for each in result.findings] == ["drift"] and "lower.fz drifts by +" in result.findings[0].text

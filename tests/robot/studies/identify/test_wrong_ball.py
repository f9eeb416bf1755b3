"""A ball of another radius than stated is noticed by how wide it dents the gel; without heights that is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.materials.fit import Noise, Point, Press, Priors
from robot.studies.identify.identify import Identified, identify
from robot.studies.identify.recordings import Recordings
from robot.studies.identify.simulation import SensorView, Simulation, shape_signals
from tacsim.config import load_scene
from tacsim.interface import Pose
from tacsim.models.scene import Scene
from tacsim.models.sensor import CanonicalGrid

SEEN = {"lower": SensorView(CanonicalGrid(), None, np.ones((64, 64), np.bool_))}
NOISE = Noise(force=0.02)
DEPTHS = np.array([-0.2, -0.1, 0.3, 0.6, 0.9, -0.2]) * 1e-3


def scene(radius: float, stiffness: str = "145 kPa", poisson_ratio: float = 0.47) -> Scene:
    ball = f"indenter.geometry={{shape: sphere, radius: {radius} mm}}"
    gel = (f"gel.material.youngs_modulus={stiffness}", f"gel.material.poisson_ratio={poisson_ratio}")
    return load_scene("press", ["preset=learn", ball, *gel])


def press(radius: float, channels: tuple[str, ...] = ("fx", "fz", "dent", "width")) -> Press:
    """A press of the lowest point of a ball to DEPTHS, nothing measured yet."""
    poses = {"indenter": tuple(Pose(np.array([0.0, 0.0, radius * 1e-3 - depth])) for depth in DEPTHS)}
    count = len(DEPTHS)
    readings = {f"lower.{name}": np.zeros(count) for name in channels}
    if "width" in channels:
        readings["lower.width"][DEPTHS < 0.3e-3] = np.nan  # a dent of nothing has no width
    return Press(f"ball {radius}", poses, readings, np.arange(count, dtype=float), np.ones(count, np.int64))


def recorded(
    radius: float, taken_for: float, channels: tuple[str, ...] = ("fx", "fz", "dent", "width"), nu: float = 0.47
) -> Press:
    """A press of a ball of `radius` on a gel of 190 kPa, with noise, whose poses say `taken_for`."""
    true = press(radius, channels)
    [signals] = Simulation(scene(radius, "190 kPa", nu), (), (true,), SEEN)([Point(np.zeros(0), np.zeros(1))])
    draw, begin, readings = np.random.default_rng(0), 0, {}
    for name, values in true.readings.items():
        there = np.isfinite(values)
        readings[name] = np.where(there, 0.0, np.nan)
        readings[name][there] = signals[begin : begin + there.sum()]
        begin += int(there.sum())
        if name.partition(".")[2] in ("fx", "fz"):
            readings[name] = readings[name] + draw.normal(0, NOISE.force, len(values))
    return replace(press(taken_for, channels), readings=readings)


def found(ball: Press, radius: float) -> Identified:
    recordings = Recordings(scene(radius))
    recordings.sensor_views = SEEN
    return identify(
        "gel", scene(radius), recordings, [ball], NOISE, Priors(0.02e-3, 0.2), wanted=["youngs_modulus"]
    )  # fmt: skip


def test_a_ball_of_5_mm_taken_for_one_of_4_mm_is_noticed() -> None:
    assert [each.kind for each in found(recorded(5, 4), 4).findings] == ["size"]


def test_a_ball_that_is_as_stated_is_not() -> None:
    result = found(recorded(4, 4), 4)
    assert result.findings == () and result.fit.value("youngs_modulus") == pytest.approx(190e3, rel=0.05)


@pytest.mark.slow
def test_without_heights_it_is_said_that_nothing_tells_the_ball() -> None:
    """Hertz: the force alone knows E sqrt(R)."""
    forces = ("fx", "fz")
    wrong, right = found(recorded(5, 4, forces), 4), found(recorded(4, 4), 4)
    assert wrong.findings == () and wrong.size_error > 0.1 > right.size_error


@pytest.mark.slow
@pytest.mark.parametrize("taken_for", [8.0, 5.0])
def test_of_two_balls_one_that_is_wrong_is_noticed_by_forces_alone(taken_for: float) -> None:
    """By Hertz a ball of 8 mm for one of 5 mm makes the gel 26 % stiffer for it than for the other ball."""
    small, large = (
        replace(recorded(radius, stated, ("fz",)), ball=stated * 1e-3, name=name)
        for radius, stated, name in ((2.0, 2.0, "small"), (8.0, taken_for, "large"))
    )
    result = identify(
        "gel", scene(4), Recordings(scene(4)), [small, large], NOISE, Priors(0.02e-3, 0.2), wanted=["youngs_modulus"]
    )  # fmt: skip
    assert bool(result.findings) == (taken_for != 8.0)
    low, high = result.fit.interval("youngs_modulus")
    assert low < 190e3 < high or result.findings


def test_width_of_a_dent_by_a_ball() -> None:
    """A sphere of radius R cut by the plane of the gel: h = d - r^2 / 2 R, of which what is deeper than d / 4 counts.
    (sum h^2)^2 / sum h^4 is then 10/9 pi R d (1 - 1/64)^2 / (1 - 1/1024)."""
    grid, r, d = CanonicalGrid(), 4e-3, 0.8e-3
    x = (np.arange(64) - 31.5) * grid.pitch
    square = x[:, None] ** 2 + x[None, :] ** 2
    height = np.maximum(d - square / (2 * r), 0.0).astype(np.float32)
    width = shape_signals("lower", height, None, np.ones((64, 64), np.bool_), grid.pitch)["lower.width"]
    assert width == pytest.approx(np.sqrt(10 / 9 * r * d * (1 - 1 / 64) ** 2 / (1 - 1 / 1024)), rel=0.01)

"""A ball of another radius than stated is noticed by how wide it dents the gel; without heights that is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.materials.estimate import Point, Priors
from calibration.materials.presses import Noise, Press
from robot.studies.identify.identify import Identified, identify
from robot.studies.identify.recordings import Recordings
from robot.studies.identify.simulation import Seen, Simulation, shape_signals
from tacsim.config import load_scene
from tacsim.interface import Pose
from tacsim.models.scene import Scene
from tacsim.models.sensor import CanonicalGrid

SEEN = {"lower": Seen(CanonicalGrid(), None, np.ones((64, 64), np.bool_))}
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
    recordings.seen = SEEN
    return identify(
        "gel", scene(radius), recordings, [ball], NOISE, Priors(0.02e-3, 0.2), wanted=["youngs_modulus"]
    )  # fmt: skip


def test_a_ball_of_5_mm_taken_for_one_of_4_mm_is_noticed() -> None:
    assert [each.kind for each in found(recorded(5, 4), 4).findings] == ["size"]


def test_a_ball_that_is_as_stated_is_not() -> None:
    result = found(recorded(4, 4), 4)
    assert result.findings == () and result.fit.value("youngs_modulus") == pytest.approx(190e3, rel=0.05)


def test_without_heights_it_is_said_that_nothing_tells_the_ball() -> None:
    """Hertz: the force alone knows E sqrt(R)."""
    forces = ("fx", "fz")
    wrong, right = found(recorded(5, 4, forces), 4), found(recorded(4, 4), 4)
    assert wrong.findings == () and wrong.size_error > 0.1 > right.size_error


def test_two_balls_tell_by_forces_alone_what_one_does_not() -> None:
    """A ball that is wide over the thickness of a bonded gel feels that it hardly changes its volume; a small one does
    not (Dimitriadis et al. 2002)."""
    quiet, forces, wanted = Noise(force=5e-3), ("fz",), ["youngs_modulus", "poisson_ratio"]
    small, large = (
        replace(recorded(radius, radius, forces, 0.45), ball=radius * 1e-3, name=name)
        for radius, name in ((2, "small"), (8, "large"))
    )
    recordings, priors = Recordings(scene(4)), Priors(0.01e-3, 0.05)
    alone = identify("gel", scene(4), recordings, [small], quiet, priors, wanted=wanted)
    both = identify("gel", scene(4), recordings, [small, large], quiet, priors, wanted=wanted)
    assert [each.name for each in alone.fit.untold] == ["poisson_ratio"] and not both.fit.untold
    for name, truth in (("poisson_ratio", 0.45), ("youngs_modulus", 190e3)):
        low, high = both.fit.interval(name)
        assert low < truth < high
    assert both.findings == ()


def test_width_of_a_dent_by_a_ball() -> None:
    """A sphere of radius R cut by the plane of the gel: h = d - r^2 / 2 R, of which what is deeper than d / 4 counts.
    (sum h^2)^2 / sum h^4 is then 10/9 pi R d (1 - 1/64)^2 / (1 - 1/1024)."""
    grid, r, d = CanonicalGrid(), 4e-3, 0.8e-3
    x = (np.arange(64) - 31.5) * grid.pitch
    square = x[:, None] ** 2 + x[None, :] ** 2
    height = np.maximum(d - square / (2 * r), 0.0).astype(np.float32)
    width = shape_signals("lower", height, None, np.ones((64, 64), np.bool_), grid.pitch)["lower.width"]
    assert width == pytest.approx(np.sqrt(10 / 9 * r * d * (1 - 1 / 64) ** 2 / (1 - 1 / 1024)), rel=0.01)

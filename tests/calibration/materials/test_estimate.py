"""Identification on closed forms: a ball on a half-space (Hertz 1881) that is then slid (Coulomb)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from calibration.materials.checks import find_contradictions
from calibration.materials.estimate import CannotSimulate, NotIdentified, estimate_materials
from calibration.materials.fit import Fit, Parameter, Point, Predict, Priors, Signals
from tacsim.interface import FloatArray

E, NU, MU, RADIUS = 0.18e6, 0.47, 0.45, 4e-3
STIFFNESS = Parameter("youngs_modulus", 0.1e6, 1e3, 1e9)
FRICTION = Parameter("friction", 0.8, 0.01, 5.0)
POISSON = Parameter("poisson_ratio", 0.45, 0.0, 0.499, "volume")
DEPTHS = np.concatenate([np.linspace(-0.2, 0.8, 11), [0.8, 0.8, 0.8]]) * 1e-3
SLID = np.array([False] * 11 + [True] * 3)
PRIORS = Priors(place=0.02e-3, zero=0.1)
NOISE = 5e-3


def hertz(modulus: float, nu: float, mu: float, place: float, power: float = 1.5) -> FloatArray:
    """(14, 2) normal and sideways force [N] of one press."""
    depth = np.maximum(DEPTHS + place, 0.0)
    normal = 4 / 3 * modulus / (1 - nu**2) * np.sqrt(RADIUS) * depth**power * 0.8e-3 ** (1.5 - power)
    return np.column_stack([-normal, np.where(SLID, mu * normal, 0.0)])


def model(names: Sequence[str], presses: int = 3, stiffer: float = 1.0):
    def predict(points: Sequence[Point]) -> list[FloatArray]:
        found = []
        for point in points:
            known = {"youngs_modulus": E, "poisson_ratio": NU, "friction": MU}
            for name, free in zip(names, point.free, strict=True):
                known[name] = {"poisson_ratio": POISSON}.get(name, STIFFNESS).value(float(free))
            parts = [
                hertz(stiffer * known["youngs_modulus"], known["poisson_ratio"], known["friction"], place)
                for place in point.places
            ]
            found.append(np.concatenate(parts).ravel())
        return found

    return predict


def recorded(seed: int, presses: int = 3, power: float = 1.5, drift: float = 0.0, noise: float = NOISE) -> Signals:
    """Presses whose places and zeros are off by what the priors say, with noise."""
    draw = np.random.default_rng(seed)
    forces = []
    for press in range(presses):
        each = hertz(E, NU, MU, draw.normal(0, PRIORS.place), power) + draw.normal(0, PRIORS.zero, 2)
        each[:, 0] += drift * np.linspace(0, 1, len(DEPTHS)) * (press == 1)
        forces.append(each + draw.normal(0, noise, each.shape))
    count = len(DEPTHS)
    return Signals(
        values=np.concatenate(forces).ravel(),
        noise=np.full(2 * count * presses, noise),
        press=np.repeat(np.arange(presses), 2 * count),
        channel=np.tile([0, 1], count * presses),
        time=np.tile(np.repeat(np.arange(count, dtype=float), 2), presses),
        channels=("fz", "fx"),
        force=np.array([True, True]),
    )


def fitted(signals: Signals, *parameters: Parameter, **more) -> Fit:
    return estimate_materials(
        [model([each.name for each in parameters])], signals, parameters, PRIORS, coarse_error=0.0, **more
    )


def test_stiffness_and_friction_of_a_ball_on_a_half_space() -> None:
    fit = fitted(recorded(1), STIFFNESS, FRICTION)
    for name, truth in (("youngs_modulus", E), ("friction", MU)):
        low, high = fit.interval(name)
        assert low < truth < high and high / low < 1.15
    assert find_contradictions(fit, recorded(1), ("a", "b", "c")) == []


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    hits = np.zeros(2)
    for seed in range(200):
        fit = fitted(recorded(seed), STIFFNESS, FRICTION)
        for k, (name, truth) in enumerate((("youngs_modulus", E), ("friction", MU))):
            low, high = fit.interval(name)
            hits[k] += low < truth < high
    # 95 % of 200 is 190; binomial: between 180 and 199 with a chance of 99.9 %
    assert (hits >= 180).all() and (hits <= 199).all()


def test_what_a_half_space_does_not_tell_is_refused() -> None:
    """Hertz' law knows E / (1 - nu^2) alone: Poisson's ratio stays where it was, and is named."""
    fit = fitted(recorded(2), STIFFNESS, POISSON)
    assert [each.name for each in fit.unidentified] == ["poisson_ratio"]
    assert [each.name for each in fit.identified] == ["youngs_modulus"]
    assert fit.value("poisson_ratio") == pytest.approx(POISSON.start)
    assert fit.value("youngs_modulus") / (1 - POISSON.start**2) == pytest.approx(E / (1 - NU**2), rel=0.1)
    low, high = fit.interval("youngs_modulus")
    assert low < E < high  # it knows that the ratio is a guess


def sticking(log: Callable[[float], float], share: float, most: float) -> Predict:
    """Stiffness and friction, a share of what it is, of a ball that sticks beyond the friction `most`."""
    right = model(["youngs_modulus", "friction"])

    def predict(points: Sequence[Point]) -> list[FloatArray]:
        return right([
            replace(point, free=np.array([point.free[0], min(point.free[1] + log(share), log(most))]))
            for point in points
        ])  # fmt: skip

    return predict


def test_a_way_that_leads_to_where_nothing_slips_goes_on_from_its_start() -> None:
    """The coarsest mesh passes on 0.4 of the friction, and asks for 1.1. Beyond 0.6 the others stick: there nothing
    tells friction, and it would be held where it began."""
    parameters, signals = (STIFFNESS, Parameter("friction", 0.3, 0.01, 5.0)), recorded(9)
    log = parameters[1].free
    fit = estimate_materials(
        [sticking(log, 0.4, 5.0), sticking(log, 1.0, 0.6), sticking(log, 1.0, 0.6)], signals, parameters, PRIORS
    )
    assert fit.unidentified == () and fit.value("friction") == pytest.approx(MU, rel=0.03)


def test_friction_is_found_from_where_things_slip_although_they_stick_at_what_was_thought() -> None:
    """The force of what sticks does not depend on friction; nothing told of it stays what was thought, 0.8."""
    thought = replace(FRICTION, begin=0.25)
    level = sticking(thought.free, 1.0, 0.6)
    fit = estimate_materials([level], recorded(9), (STIFFNESS, thought), PRIORS, coarse_error=0.0)
    assert fit.unidentified == () and fit.value("friction") == pytest.approx(MU, rel=0.03)
    level = sticking(thought.free, 1.0, 0.2)
    fit = estimate_materials([level], recorded(9), (STIFFNESS, thought), PRIORS, coarse_error=0.0)
    assert [each.name for each in fit.unidentified] == ["friction"] and fit.value("friction") == pytest.approx(0.8)


def test_steps_that_move_less_than_a_mesh_is_wrong_are_not_made() -> None:
    """Meshes that are 5 % and 2 % off, three presses: 22 points each with steps that only noise asks for."""
    names, signals = ["youngs_modulus", "friction"], recorded(10)
    levels = [model(names, stiffer=stiffer) for stiffer in (1.05, 1.02, 1.0)]
    fit = estimate_materials(levels, signals, (STIFFNESS, FRICTION), PRIORS)
    assert fit.value("youngs_modulus") == pytest.approx(E, rel=0.03) and fit.runs <= 3 * 17


def test_a_press_that_does_not_slide_tells_no_friction() -> None:
    signals = recorded(3)
    still = Signals(
        *(getattr(signals, name)[signals.channel == 0] for name in ("values", "noise", "press", "channel", "time")),
        channels=("fz",),
        force=np.array([True]),
    )

    def predict(points: Sequence[Point]) -> list[FloatArray]:
        return [each[::2] for each in model(["youngs_modulus", "friction"])(points)]

    fit = estimate_materials([predict], still, (STIFFNESS, FRICTION), PRIORS, coarse_error=0.0)
    assert [each.name for each in fit.unidentified] == ["friction"]


def test_noise_of_a_robots_own_sensor_is_refused() -> None:
    with pytest.raises(NotIdentified, match="do not identify youngs_modulus"):
        estimate_materials(
            [model(["youngs_modulus"])], recorded(4, noise=3.0), (STIFFNESS,), Priors(2e-5, 3.0), coarse_error=0.0
        )


def test_a_zero_that_drifts_is_noticed() -> None:
    signals = recorded(5, drift=0.1)
    found = find_contradictions(fitted(signals, STIFFNESS, FRICTION), signals, ("a", "b", "c"))
    assert [each.kind for each in found] == ["drift"] and "b: the zero of fz drifts by +0.1" in found[0].text


def test_a_contact_of_another_shape_is_noticed() -> None:
    """The force of a flat punch is proportional to the depth, that of a ball to its power of 3/2."""
    signals = recorded(6, power=1.0)
    found = find_contradictions(fitted(signals, STIFFNESS, FRICTION), signals, ("a", "b", "c"))
    assert found and found[0].kind in ("misfit", "drift")


def test_nothing_is_noticed_where_nothing_is_wrong() -> None:
    noticed = 0
    for seed in range(100, 200):
        signals = recorded(seed)
        noticed += bool(find_contradictions(fitted(signals, STIFFNESS, FRICTION), signals, ("a", "b", "c")))
    assert noticed <= 2


def test_a_coarse_simulation_is_put_right_by_a_finer_one() -> None:
    """A coarse mesh that is 15 % too stiff; the interval keeps half of what the finer one changed."""
    parameters, signals = (STIFFNESS, FRICTION), recorded(7)
    names = [each.name for each in parameters]
    right = estimate_materials([model(names)], signals, parameters, PRIORS, coarse_error=0.0)
    fit = estimate_materials([model(names, stiffer=1.15), model(names)], signals, parameters, PRIORS)
    assert fit.value("youngs_modulus") == pytest.approx(right.value("youngs_modulus"), rel=0.02)
    assert fit.mesh_shift[0] == pytest.approx(np.log(1.15), abs=0.03)
    low, high = fit.interval("youngs_modulus")
    assert np.log(high / low) / 2 > 1.9 * 0.5 * np.log(1.15)


def test_errors_of_a_mesh_that_cancel_in_one_fit_still_count() -> None:
    """A coarse mesh that is 15 % too stiff in one press and too soft in the other: together they move nothing, and what
    is left of each, half of it, moves the stiffness by up to 0.5 log(1.15) / 2, twice in quadrature."""
    signals, right = recorded(7, presses=2), model(["youngs_modulus"], presses=2)
    stiffer = np.where(signals.press == 0, 1.15, 1 / 1.15)
    fit = estimate_materials(
        [lambda points: [stiffer * each for each in right(points)], right], signals, (STIFFNESS,), PRIORS
    )
    low, high = fit.interval("youngs_modulus")
    assert low < E < high and np.log(high / low) / 2 > 1.96 * 0.7 * 0.5 * np.log(1.15) / np.sqrt(2)


def test_what_settling_leaves_of_a_whole_press_does_not_average_out() -> None:
    """A press that is off by 1 % as a whole, as one that has not come to rest: its 14 readings are no 14 opinions."""
    right, priors = model(["youngs_modulus"], presses=1), Priors(place=1e-7, zero=1e-6)
    signals = recorded(0, presses=1, noise=1e-4)
    (clean,) = right([Point(np.array([STIFFNESS.free(E)]), np.zeros(1))])
    fit = estimate_materials([right, right], replace(signals, values=1.01 * clean), (STIFFNESS,), priors)
    low, high = fit.interval("youngs_modulus")
    assert fit.value("youngs_modulus") == pytest.approx(1.01 * E, rel=1e-3)
    assert low < E < high < 1.05 * E


def test_channels_that_contradict_each_other_widen_the_interval() -> None:
    """One press says 10 % more than the truth and another 10 % less, as a simulation has it that no mesh puts right.
    Each has 14 readings; they are two opinions, between which the truth may be anywhere."""
    signals = recorded(0, presses=2, noise=1e-3)
    (clean,) = model(["youngs_modulus"])([Point(np.array([STIFFNESS.free(E)]), np.zeros(2))])
    said = np.where(signals.press == 0, 1.1, 0.9) * clean
    low, high = fitted(replace(signals, values=said), STIFFNESS).interval("youngs_modulus")
    assert low < 0.9 * E and high > 1.1 * E


def test_a_step_that_cannot_be_simulated_is_made_smaller() -> None:
    """A little beyond the true stiffness nothing can be simulated; the fit begins softer, and its step overshoots."""
    soft, signals = Parameter("youngs_modulus", 0.1e6, 1e3, 1e9), recorded(8)
    right, refused = model(["youngs_modulus"]), []

    def predict(points: Sequence[Point]) -> list[FloatArray]:
        if any(soft.value(float(point.free[0])) > 1.09 * E for point in points):
            refused.append(points)
            raise CannotSimulate("too stiff")
        return right(points)

    # the linear step from 0.1 MPa asks for 0.1 exp(0.8) MPa, bounded by a factor of two: 0.201 MPa
    fit = estimate_materials([predict], signals, (soft,), PRIORS, coarse_error=0.0)
    assert refused and fit.value("youngs_modulus") == pytest.approx(E, rel=0.05)

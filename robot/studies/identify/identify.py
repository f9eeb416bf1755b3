"""Materials from recorded presses and squeezes: the parameters, the fit, and checks of the result."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calibration.materials.checks import Finding, find_contradictions, indenter_size_error
from calibration.materials.estimate import estimate_materials
from calibration.materials.fit import (
    Fit,
    Noise,
    Parameter,
    Point,
    Press,
    Priors,
    Signals,
    downsample_press,
    merge_repeated_readings,
    signals_of,
)
from calibration.materials.tuning import COARSE_SIMULATION_ERROR
from robot.studies.identify.recordings import Recordings
from robot.studies.identify.simulation import Simulation, coarser, scene_with
from robot.studies.tuning import FIRST_FRICTION, FIRST_YIELD
from tacsim.interface import FloatArray
from tacsim.models.material import elastic_constants
from tacsim.models.scene import Scene
from tacsim.models.text import suggest_word

Kind = Literal["gel", "body"]
# noise that removes the width of a dent from a fit: width identifies indenters, not materials [m]
UNWEIGHTED_NOISE = 0.01
MOMENTS = 16  # simulated moments of a press
MAX_FACTOR = 30.0  # between stiffness or yield and the start of the fit


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """A fit, its data, and findings that contradict it."""

    kind: Kind
    scene: Scene  # with the materials found
    fit: Fit
    presses: tuple[Press, ...]
    signals: Signals
    findings: tuple[Finding, ...]
    noise: Noise
    checked: Fit  # with the weights of the checks, which include the width of dents
    by_size: FloatArray | None = None  # (m, b) derivative of the signals by the logarithm of the size of each indenter

    @property
    def size_error(self) -> float | None:
        """Relative standard deviation of the size of an indenter, from these presses alone."""
        return None if self.by_size is None else indenter_size_error(self.checked, self.by_size)


def parameters_of(kind: Kind, scene: Scene) -> tuple[Parameter, ...]:
    """All parameters of a kind, starting at the values of the scene."""
    max_nu, lowest, highest = 0.499, 0.01, 5.0  # of the Poisson ratio; of the friction
    if kind == "gel":
        assert scene.indenter is not None
        gel = scene.gel.material
        nu, mu = min(gel.poisson_ratio, 0.49), min(max(scene.indenter.friction, 0.1), 1.0)
        return (
            _parameter_around("youngs_modulus", gel.youngs_modulus),
            Parameter("poisson_ratio", nu, 0.0, max_nu, "volume"),
            Parameter("friction", mu, lowest, highest),
        )
    assert scene.body is not None
    material = scene.body.material
    limit, (shear, _) = material.elastic_limit, elastic_constants(material)
    strength = math.sqrt(1.5) * 2 * shear * limit if math.isfinite(limit) else FIRST_YIELD * material.youngs_modulus
    frictions = (
        Parameter(f"friction_{name}", min(max(mu, 0.1), 1.0), lowest, highest, begin=min(max(mu, 0.1), FIRST_FRICTION))
        for name, mu in scene.friction.items()
    )
    return (
        _parameter_around("youngs_modulus", material.youngs_modulus),
        _parameter_around("yield_stress", strength),
        Parameter("hardening_modulus", material.hardening_modulus, 0.0, MAX_FACTOR * strength, "linear", strength),
        *frictions,
    )


def _parameter_around(name: str, value: float) -> Parameter:
    return Parameter(name, value, value / MAX_FACTOR, value * MAX_FACTOR)


def identify(
    kind: Kind,
    scene: Scene,
    recordings: Recordings,
    presses: Sequence[Press],
    noise: Noise,
    priors: Priors,
    *,
    wanted: Sequence[str] = (),
    max_moments: int = MOMENTS,
    gel_error: float = 0.0,
    on_step: Callable[[str], None] = lambda words: None,
    on_run: Callable[[int, int], None] = lambda done, total: None,
) -> Identified:
    """Fits the materials of `scene` to the presses.

    The fit starts on coarser meshes, and ends on the mesh of the scene.

    Args:
        wanted: names of parameters; empty: all.
        max_moments: simulated moments of a press.
        gel_error: relative standard deviation of the gels' stiffness; it widens the intervals of a body.

    Raises:
        NotIdentified, CannotSimulate.
        ValueError: a name in `wanted` is no parameter.
    """
    parameters = parameters_of(kind, scene)
    names = [each.name for each in parameters]
    unknown = [name for name in wanted if name not in names]
    if unknown:
        hint = suggest_word(unknown[0], names)
        raise ValueError(f"'{unknown[0]}' is not a parameter of a {kind}; allowed: {', '.join(names)}{hint}")
    parameters = tuple(each for each in parameters if not wanted or each.name in wanted)
    taken = tuple(downsample_press(merge_repeated_readings(press), max_moments) for press in presses)
    signals = signals_of(taken, noise)
    start = scene_with(scene, {each.name: each.start for each in parameters})
    exact = Simulation(start, parameters, taken, recordings.sensor_views, on_run)
    error = COARSE_SIMULATION_ERROR
    levels = [replace(exact, scene=coarser(start)), exact]
    coarse = levels[0].scene
    layers = [2 * coarse.element_size_of(name) <= scene.gel_of(name).size[2] / 2 for name in scene.sensors]
    if kind == "body" and all(layers):  # else the gel has too few layers
        levels.insert(0, replace(exact, scene=coarser(coarse)))
        error *= 2
    width = np.array([name.endswith(".width") for name in signals.channels])[signals.channel]
    fit = estimate_materials(
        levels, replace(signals, noise=np.where(width, UNWEIGHTED_NOISE, signals.noise)), parameters, priors, error,
        on_step,
    )  # fmt: skip
    if gel_error > 0 and kind == "body":
        fit = _with_gel_error(fit, signals, gel_error)
    found = scene_with(start, {each.name: fit.value(each.name) for each in fit.parameters})
    by_size = None
    if kind == "gel":
        on_step("size of the indenter")
        by_all = levels[0].by_size(Point(fit.free, fit.nuisances[: len(taken)]))
        balls = np.array([press.ball or 0.0 for press in taken])
        by_size = np.stack([np.where(balls[signals.press] == ball, by_all, 0.0) for ball in np.unique(balls)], axis=1)
    sigma = np.sqrt(fit.sigma**2 - np.where(width, UNWEIGHTED_NOISE**2 - signals.noise**2, 0.0))
    checked = replace(fit, sigma=sigma)
    contradictions = find_contradictions(checked, signals, tuple(press.name for press in taken), by_size)
    return Identified(kind, found, fit, taken, signals, tuple(contradictions), noise, checked, by_size)


def _with_gel_error(fit: Fit, signals: Signals, error: float) -> Fit:
    """The fit with intervals that include the relative error of the gels' stiffness.

    Forces are homogeneous of degree one in all moduli and stresses, heights of degree zero (quasi-statics). So the
    derivative by the gels' modulus needs no simulation: it is the force minus the derivatives by the body's moduli.
    """
    force = signals.force[signals.channel]
    by_gel = np.where(force, fit.predicted, 0.0)
    for index, each in enumerate(fit.parameters):
        if each.name in ("youngs_modulus", "yield_stress"):
            by_gel = by_gel - fit.system[:, index]
        elif each.name == "hardening_modulus":
            by_gel = by_gel - fit.free[index] * fit.system[:, index]
    shift = fit.parameter_change(by_gel)
    return replace(fit, covariance=fit.covariance + error**2 * np.outer(shift, shift))


def predict_intervals(identified: Identified, force_noise: float) -> dict[str, float]:
    """Half the 95 % interval of each parameter (of its free number) at another force noise [N], without simulation."""
    fit, signals = identified.fit, identified.signals
    force = signals.force[signals.channel]
    scale = np.where(force, force_noise / identified.noise.force, 1.0)
    sigma = np.sqrt(np.maximum(fit.sigma**2 - signals.noise**2, 0.0) + (signals.noise * scale) ** 2)
    other = fit.with_sigma(sigma).widen_intervals(signals.values - fit.predicted, signals.series)
    return {each.name: other.half_interval(each.name) for each in fit.identified}

"""Least squares of a simulation against recorded presses: values, intervals, and what the data do not tell.

Unknowns are the parameters of the materials, and for each press two nuisances that every rig has: its place is off by a
little along the closing direction, and so is the zero of its force. These have a standard deviation given beforehand.
Gauss-Newton with Levenberg's damping: a whole Jacobian costs one batch of perturbed simulations.

A coarse simulation finds the way; a finer one, run at the estimate, says by how much the coarse one is wrong there
(space mapping: Bandler et al. 1994). How far that moved the estimate tells what is left of the mesh's error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.errors import CalibrationError
from calibration.materials.fit import (
    MESH_ERROR_SHARE,
    Fit,
    Parameter,
    Point,
    Predict,
    Priors,
    Signals,
    covariance_of,
    fit_start_values,
    start_values,
)
from calibration.materials.tuning import (
    COARSE_SIMULATION_ERROR,
    MAX_IDENTIFIED_HALF_INTERVAL,
    MAX_START_HALF_INTERVAL,
    MAX_STEP,
    MIN_GAIN,
    MIN_STEP_DEVIATIONS,
    PARAMETER_DIFFERENCE,
    PLACE_STEP,
)
from tacsim.interface import FloatArray

MIN_GAIN_SHARE = 0.01  # of the sum of squares, where a coarse mesh keeps it large
MIN_STEP = 0.01  # of the free numbers, likewise where all are identified
SETTLING_ERROR = 0.01  # of any simulation: what its settling leaves, in each number and, again, in a whole press


class NotIdentified(CalibrationError):
    """These presses do not tell what was asked for."""


class CannotSimulate(CalibrationError):
    """A press has no simulated counterpart with such materials."""


@dataclass(slots=True, eq=False)
class _State:
    """A point, its signals, and the system linearised there."""

    point: Point
    zeros: FloatArray
    predicted: FloatArray  # (m,) without the zeros
    system: FloatArray


class _Fitter:
    def __init__(self, signals: Signals, parameters: Sequence[Parameter], priors: Priors) -> None:
        self.signals, self.parameters = signals, tuple(parameters)
        self.zero_columns = signals.zeros()
        self.priors = np.array([priors.place] * signals.presses + [priors.zero] * self.zero_columns.shape[1])
        self.sigma = signals.noise
        self.held = np.zeros(len(self.parameters), np.bool_)
        self.runs = 0
        limits = np.array([each.bounds for each in self.parameters])
        self.low, self.high = limits[:, 0], limits[:, 1]

    def linearise(self, predict: Predict, point: Point, zeros: FloatArray) -> _State:
        """One batch: the point itself, each free number changed a little, and all places at once."""
        steps = np.where(point.free + PARAMETER_DIFFERENCE > self.high, -PARAMETER_DIFFERENCE, PARAMETER_DIFFERENCE)
        points = [point, *(replace(point, free=point.free + step) for step in np.diag(steps))]
        points.append(replace(point, places=point.places + PLACE_STEP))
        found = self.run(predict, points)
        base = found[0]
        columns = [(found[1 + k] - base) / step for k, step in enumerate(steps)]
        by_place = (found[-1] - base) / PLACE_STEP
        columns += [np.where(self.signals.press == p, by_place, 0.0) for p in range(self.signals.presses)]
        return _State(point, zeros, base, np.column_stack([*columns, self.zero_columns]))

    def secant(self, predict: Predict, before: _State, point: Point, zeros: FloatArray) -> _State:
        """One run: the system of `before` with the least change that explains what the step from there did (Broyden
        1965), for each press by itself, since no press knows another's place."""
        predicted = self.run(predict, [point])[0]
        p, system = len(self.held), before.system.copy()
        step = np.concatenate([point.free - before.point.free, point.places - before.point.places])
        missed = predicted - before.predicted - system[:, : len(step)] @ step
        scale = np.append(np.ones(p), PLACE_STEP / PARAMETER_DIFFERENCE)
        for press in range(self.signals.presses):
            rows, columns = np.flatnonzero(self.signals.press == press), [*range(p), p + press]
            scaled = step[columns] / scale
            weight = (
                scaled @ scaled + PARAMETER_DIFFERENCE**2
            )  # what a smaller step missed is the simulation's own noise
            system[np.ix_(rows, columns)] += np.outer(missed[rows], scaled / scale / weight)
        return _State(point, zeros, predicted, system)

    def run(self, predict: Predict, points: Sequence[Point]) -> list[FloatArray]:
        self.runs += len(points) * self.signals.presses
        return predict(points)

    def nuisances(self, state: _State) -> FloatArray:
        return np.concatenate([state.point.places, state.zeros])

    def residual(self, state: _State) -> FloatArray:
        found: FloatArray = self.signals.values - state.predicted - self.zero_columns @ state.zeros
        return found

    def cost(self, state: _State) -> float:
        squares = float(((self.residual(state) / self.sigma) ** 2).sum())
        return squares + float(((self.nuisances(state) / self.priors) ** 2).sum())

    def step(self, state: _State, damping: float) -> FloatArray:
        """(n,) the damped least-squares step; 0 for parameters that are held."""
        p, n = len(self.held), state.system.shape[1]
        rows = state.system / self.sigma[:, None]
        rows[:, :p][:, self.held] = 0.0
        known = np.zeros((n - p, n))
        known[:, p:] = np.diag(1.0 / self.priors)
        whole = np.vstack([rows, known])
        right = np.concatenate([self.residual(state) / self.sigma, -self.nuisances(state) / self.priors])
        if damping > 0:
            whole = np.vstack([whole, np.diag(np.sqrt(damping * (whole**2).sum(axis=0)))])
            right = np.concatenate([right, np.zeros(n)])
        found: FloatArray = np.linalg.lstsq(whole, right, rcond=1e-12)[0]
        return found

    def is_small(self, state: _State, step: FloatArray, limit: float) -> bool:
        """Whether a step changes no free number by more than `limit`, or than a part of its standard deviation."""
        p = len(self.held)
        spread = np.sqrt(np.diag(covariance_of(state.system, self.sigma, self.priors, self.held, 0.0))[:p])
        return bool((np.abs(step[:p]) < np.maximum(limit, MIN_STEP_DEVIATIONS * spread)).all())

    def moved(self, state: _State, step: FloatArray) -> tuple[Point, FloatArray]:
        """Point and zeros after a step, within the bounds."""
        p, t = len(self.held), self.signals.presses
        free = np.clip(state.point.free + np.clip(step[:p], -MAX_STEP, MAX_STEP), self.low, self.high)
        return Point(free, state.point.places + step[p : p + t]), state.zeros + step[p + t :]

    def after_full_step(self, state: _State) -> _State:
        """After a whole step, and with what is held back at its start, as the system foresees it."""
        back = np.where(self.held, start_values(self.parameters) - state.point.free, 0.0)
        begun = _State(
            replace(state.point, free=state.point.free + back), state.zeros,
            state.predicted + state.system[:, : len(back)] @ back, state.system,
        )  # fmt: skip
        state, (point, zeros) = begun, self.moved(begun, self.step(begun, 0.0))
        change = np.concatenate([point.free - state.point.free, point.places - state.point.places])
        return _State(point, zeros, state.predicted + state.system[:, : len(change)] @ change, state.system)

    def reach(self, state: _State) -> FloatArray:
        """(p,) half the 95 % intervals of the free numbers, as far as the noise alone goes; 0 for those held."""
        sigma = np.hypot(self.signals.noise, SETTLING_ERROR * np.abs(state.predicted))
        covariance = covariance_of(state.system, sigma, self.priors, self.held, 0.0)
        found: FloatArray = 1.96 * np.sqrt(np.diag(covariance))[: len(self.held)]
        return found

    def hold(self, state: _State, reach: FloatArray, limit: float) -> bool:
        """Holds the parameter that is told least, if it is told too little. Raises NotIdentified for the last one."""
        worst = int(np.argmax(np.where(self.held, 0.0, reach)))
        if reach[worst] <= limit:
            return False
        self.held[worst] = True
        if self.held.all():
            names = ", ".join(each.name for each in self.parameters)
            raise NotIdentified(
                f"these recordings tell nothing of {names}: what they would change is lost in the noise; record with a "
                "better force sensor, press deeper or more often"
            )
        return True


def estimate_materials(
    levels: Sequence[Predict],
    signals: Signals,
    parameters: Sequence[Parameter],
    priors: Priors,
    coarse_error: float = COARSE_SIMULATION_ERROR,
    on_step: Callable[[str], None] = lambda words: None,
) -> Fit:
    """Fits the parameters to the signals.

    levels: the simulation on meshes from coarse to fine. The coarsest, off by a share of about `coarse_error`, finds
    a start; the last but one gives the Jacobian; the finest corrects the result. on_step: receives the present step.

    A parameter whose interval would exceed a factor of 1.8 in either direction is held at its start, the one with the
    widest interval first (`Fit.unidentified`). Raises NotIdentified if no parameter can be identified, CannotSimulate
    if no smaller step helps.
    """
    max_fine_steps = 2
    fitter = _Fitter(signals, parameters, priors)
    begin = Point(fit_start_values(parameters), np.zeros(signals.presses))
    on_step("first run")
    state = fitter.linearise(levels[0], begin, np.zeros(fitter.zero_columns.shape[1]))
    while fitter.hold(state, fitter.reach(state), MAX_START_HALF_INTERVAL):
        pass
    kept = np.where(fitter.held, start_values(parameters), begin.free)
    if (kept != begin.free).any():
        state = fitter.linearise(levels[0], replace(begin, free=kept), state.zeros)
    state = _fit_coarse(fitter, levels[0], state, coarse_error, on_step, secant=len(levels) > 2)
    for level in levels[1:-1]:
        on_step("next mesh")
        found = fitter.linearise(level, state.point, state.zeros)
        state = _restore_unidentified(fitter, level, found)
        max_steps = max_fine_steps if state is found else 2 * max_fine_steps
        state = fitter.after_full_step(_fit_coarse(fitter, level, state, coarse_error / 2, on_step, max_steps))
    while fitter.hold(state, fitter.reach(state), MAX_IDENTIFIED_HALF_INTERVAL):
        state = fitter.after_full_step(state)
    while True:
        fit = _refine_fit(fitter, state, levels[-1] if len(levels) > 1 else None, on_step)
        plain = fit.with_sigma(fit.sigma)  # signals that scatter more than they should are no lack of them
        if not fitter.hold(
            state, np.array([plain.half_interval(each.name) for each in parameters]), MAX_IDENTIFIED_HALF_INTERVAL
        ):
            return fit
        state = fitter.after_full_step(state)


def _restore_unidentified(fitter: _Fitter, predict: Predict, state: _State) -> _State:
    """The state, with parameters that nothing tells there (friction at which nothing slips) back where they began if
    that tells them: a step went too far."""
    begun, lost = (
        fit_start_values(fitter.parameters),
        ~fitter.held & (fitter.reach(state) > MAX_IDENTIFIED_HALF_INTERVAL),
    )
    if not (lost & (state.point.free != begun)).any():
        return state
    point = replace(state.point, free=np.where(lost, begun, state.point.free))
    back = fitter.linearise(predict, point, state.zeros)
    return back if (fitter.reach(back)[lost] <= MAX_IDENTIFIED_HALF_INTERVAL).any() else state


def _fit_coarse(
    fitter: _Fitter,
    predict: Predict,
    state: _State,
    error: float,
    on_step: Callable[[str], None],
    max_steps: int = 12,
    secant: bool = False,
) -> _State:
    """Damped steps by the simulation `predict`, off by a share of about `error`, `max_steps` of them. secant: one run
    each, the system brought up to date by what the step found; else linearised anew, a batch each."""
    damping = 1e-3
    for count in range(max_steps):
        fitter.sigma = np.hypot(fitter.signals.noise, error * np.abs(state.predicted))
        step = fitter.step(state, damping)
        if fitter.is_small(state, step, error / 2):
            break
        on_step(f"step {count + 1}")
        try:
            point, zeros = fitter.moved(state, step)
            after = fitter.secant(predict, state, point, zeros) if secant else fitter.linearise(predict, point, zeros)
        except CannotSimulate:
            if count + 1 == max_steps:
                raise
            damping = max(damping, 1e-3) * 100  # the step went too far
            continue
        gain = fitter.cost(state) - fitter.cost(after)
        if gain > 0:
            state, damping = after, damping / 10
        else:
            state = replace(state, system=after.system) if secant else state
            damping = max(damping, 1e-3) * 10
        if abs(gain) < max(MIN_GAIN, MIN_GAIN_SHARE * fitter.cost(state)):
            break
    return state


def _refine_fit(fitter: _Fitter, state: _State, fine: Predict | None, on_step: Callable[[str], None]) -> Fit:
    """Goes on with the differences between a finer simulation and the coarse one, and ends with the intervals."""
    max_steps = 4
    p = len(fitter.held)
    begun, coarse = state.point.free, state.predicted
    for count in range(0 if fine is None else max_steps):
        assert fine is not None
        on_step(f"finer mesh, run {count + 1}")
        exact = fitter.run(fine, [state.point])[0]
        if count == 0:
            off = exact - coarse
        noise, settled = fitter.signals.noise, SETTLING_ERROR * np.abs(exact)
        fitter.sigma = np.sqrt(noise**2 + settled**2 + (MESH_ERROR_SHARE * off) ** 2)
        here = _State(state.point, state.zeros, exact, state.system)
        state = fitter.after_full_step(here)
        if fitter.is_small(here, state.point.free - here.point.free, MIN_STEP):
            break
    shift = state.point.free - begun
    fit = Fit(
        parameters=fitter.parameters, held=fitter.held.copy(), free=state.point.free, covariance=np.zeros((p, p)),
        mesh_shift=shift, settled_shift=np.zeros((0, p)), predicted=state.predicted + fitter.zero_columns @ state.zeros,
        sigma=fitter.sigma, system=state.system, nuisances=fitter.nuisances(state), priors=fitter.priors,
        runs=fitter.runs,
    )  # fmt: skip
    series, residual = fitter.signals.series, fitter.residual(state)
    scatter = float(((residual / fitter.sigma) ** 2).sum() / fit.degrees_of_freedom)
    if fine is not None:
        # What each series is off may cancel in this sum, and not in that of what is left of it. What creeps still has
        # one sign in all of it, and so has what the finest mesh is off: it does not average out.
        apart = np.sqrt((fit.parameter_changes(off, series) ** 2).sum(axis=0))
        fit = replace(
            fit, mesh_shift=np.maximum(np.abs(shift), apart), settled_shift=fit.parameter_changes(settled, series)
        )  # fmt: skip
    noisier = fit.with_sigma(fitter.sigma * max(1.0, np.sqrt(scatter)))
    return replace(fit, covariance=noisier.covariance).widen_intervals(residual, series)

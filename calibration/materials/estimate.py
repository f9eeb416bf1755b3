"""Least-squares fit of a simulation to recorded presses: values, intervals, and parameters that are not identifiable.

Unknowns are the parameters of the materials, and two nuisance parameters for each press: an error of its place along
the closing direction, and an error of the zero of its force. Both have a prior standard deviation. The method is
Gauss-Newton with Levenberg's damping: a whole Jacobian costs one batch of perturbed simulations.

A coarse simulation finds the estimate; a finer one at the estimate gives the error of the coarse one (space mapping:
Bandler et al. 1994). The change of the estimate by the finer mesh gives the remaining error of the mesh.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.errors import CalibrationError
from calibration.materials import tuning
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
from tacsim.interface import FloatArray

MIN_GAIN_SHARE = 0.01  # of the sum of squares, if the coarse mesh dominates it
MIN_STEP = 0.01  # of the free numbers, if all are identified
SETTLING_ERROR = 0.01  # relative error of settling in any simulation, for each number and for each whole press


class NotIdentified(CalibrationError):
    """No requested parameter can be identified from these presses."""


class CannotSimulate(CalibrationError):
    """A press cannot be simulated with these materials."""


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
        """Linearises by one batch: the point itself, a small change of each free number, and one of all places."""
        steps = np.where(
            point.free + tuning.PARAMETER_DIFFERENCE > self.high,
            -tuning.PARAMETER_DIFFERENCE,
            tuning.PARAMETER_DIFFERENCE,
        )
        points = [point, *(replace(point, free=point.free + step) for step in np.diag(steps))]
        points.append(replace(point, places=point.places + tuning.PLACE_STEP))
        found = self.run(predict, points)
        base = found[0]
        columns = [(found[1 + k] - base) / step for k, step in enumerate(steps)]
        by_place = (found[-1] - base) / tuning.PLACE_STEP
        columns += [np.where(self.signals.press == p, by_place, 0.0) for p in range(self.signals.presses)]
        return _State(point, zeros, base, np.column_stack([*columns, self.zero_columns]))

    def secant(self, predict: Predict, before: _State, point: Point, zeros: FloatArray) -> _State:
        """Linearises by one run: the system of `before` with the smallest change that explains the last step (Broyden
        1965), separately for each press, because the place of a press affects no other press."""
        predicted = self.run(predict, [point])[0]
        p, system = len(self.held), before.system.copy()
        step = np.concatenate([point.free - before.point.free, point.places - before.point.places])
        missed = predicted - before.predicted - system[:, : len(step)] @ step
        scale = np.append(np.ones(p), tuning.PLACE_STEP / tuning.PARAMETER_DIFFERENCE)
        for press in range(self.signals.presses):
            rows, columns = np.flatnonzero(self.signals.press == press), [*range(p), p + press]
            scaled = step[columns] / scale
            weight = (
                scaled @ scaled + tuning.PARAMETER_DIFFERENCE**2
            )  # the residual after a smaller step is noise of the simulation
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
        """(n,) the damped least-squares step; 0 for fixed parameters."""
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
        """True if a step changes each free number by less than `limit`, or than a part of its standard deviation."""
        p = len(self.held)
        spread = np.sqrt(np.diag(covariance_of(state.system, self.sigma, self.priors, self.held, 0.0))[:p])
        return bool((np.abs(step[:p]) < np.maximum(limit, tuning.MIN_STEP_DEVIATIONS * spread)).all())

    def moved(self, state: _State, step: FloatArray) -> tuple[Point, FloatArray]:
        """Point and zeros after a step, within the bounds."""
        p, t = len(self.held), self.signals.presses
        free = np.clip(state.point.free + np.clip(step[:p], -tuning.MAX_STEP, tuning.MAX_STEP), self.low, self.high)
        return Point(free, state.point.places + step[p : p + t]), state.zeros + step[p + t :]

    def after_full_step(self, state: _State) -> _State:
        """The state predicted by the system after a whole step, with fixed parameters at their start."""
        back = np.where(self.held, start_values(self.parameters) - state.point.free, 0.0)
        begun = _State(
            replace(state.point, free=state.point.free + back), state.zeros,
            state.predicted + state.system[:, : len(back)] @ back, state.system,
        )  # fmt: skip
        state, (point, zeros) = begun, self.moved(begun, self.step(begun, 0.0))
        change = np.concatenate([point.free - state.point.free, point.places - state.point.places])
        return _State(point, zeros, state.predicted + state.system[:, : len(change)] @ change, state.system)

    def reach(self, state: _State) -> FloatArray:
        """(p,) half the 95 % intervals of the free numbers from the noise alone; 0 for fixed ones."""
        sigma = np.hypot(self.signals.noise, SETTLING_ERROR * np.abs(state.predicted))
        covariance = covariance_of(state.system, sigma, self.priors, self.held, 0.0)
        found: FloatArray = 1.96 * np.sqrt(np.diag(covariance))[: len(self.held)]
        return found

    def hold(self, state: _State, reach: FloatArray, limit: float) -> bool:
        """Fixes the parameter with the widest interval if that is too wide. Raises NotIdentified for the last one."""
        worst = int(np.argmax(np.where(self.held, 0.0, reach)))
        if reach[worst] <= limit:
            return False
        self.held[worst] = True
        if self.held.all():
            names = ", ".join(each.name for each in self.parameters)
            raise NotIdentified(
                f"these recordings do not identify {names}: their effect is below the noise; record with a "
                "better force sensor, press deeper or more often"
            )
        return True


def estimate_materials(
    levels: Sequence[Predict],
    signals: Signals,
    parameters: Sequence[Parameter],
    priors: Priors,
    coarse_error: float = tuning.COARSE_SIMULATION_ERROR,
    on_step: Callable[[str], None] = lambda words: None,
) -> Fit:
    """Fits the parameters to the signals.

    A parameter whose interval would exceed a factor of 1.8 in either direction is fixed at its start, the one with the
    widest interval first (`Fit.unidentified`).

    Args:
        levels: the simulation on meshes from coarse to fine. The coarsest, with a relative error of about
            `coarse_error`, finds a start; the last but one gives the Jacobian; the finest corrects the result.
        on_step: receives the name of the present step.

    Raises:
        NotIdentified: no parameter can be identified.
        CannotSimulate: also with smaller steps.
    """
    max_fine_steps = 2
    fitter = _Fitter(signals, parameters, priors)
    begin = Point(fit_start_values(parameters), np.zeros(signals.presses))
    on_step("first run")
    state = fitter.linearise(levels[0], begin, np.zeros(fitter.zero_columns.shape[1]))
    while fitter.hold(state, fitter.reach(state), tuning.MAX_START_HALF_INTERVAL):
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
    while fitter.hold(state, fitter.reach(state), tuning.MAX_IDENTIFIED_HALF_INTERVAL):
        state = fitter.after_full_step(state)
    while True:
        fit = _refine_fit(fitter, state, levels[-1] if len(levels) > 1 else None, on_step)
        plain = fit.with_sigma(fit.sigma)  # large scatter of the signals does not mean that data are missing
        if not fitter.hold(
            state,
            np.array([plain.half_interval(each.name) for each in parameters]),
            tuning.MAX_IDENTIFIED_HALF_INTERVAL,
        ):
            return fit
        state = fitter.after_full_step(state)


def _restore_unidentified(fitter: _Fitter, predict: Predict, state: _State) -> _State:
    """The state, in which parameters that are not identifiable there (friction at which nothing slips) return to their
    start if that identifies them, because a step was too large."""
    begun, lost = (
        fit_start_values(fitter.parameters),
        ~fitter.held & (fitter.reach(state) > tuning.MAX_IDENTIFIED_HALF_INTERVAL),
    )
    if not (lost & (state.point.free != begun)).any():
        return state
    point = replace(state.point, free=np.where(lost, begun, state.point.free))
    back = fitter.linearise(predict, point, state.zeros)
    return back if (fitter.reach(back)[lost] <= tuning.MAX_IDENTIFIED_HALF_INTERVAL).any() else state


def _fit_coarse(
    fitter: _Fitter,
    predict: Predict,
    state: _State,
    error: float,
    on_step: Callable[[str], None],
    max_steps: int = 12,
    secant: bool = False,
) -> _State:
    """Up to `max_steps` damped steps with the simulation `predict`, whose relative error is about `error`. secant: each
    step costs one run, whose result updates the system; otherwise each step linearises again with a batch."""
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
            damping = max(damping, 1e-3) * 100  # the step was too large
            continue
        gain = fitter.cost(state) - fitter.cost(after)
        if gain > 0:
            state, damping = after, damping / 10
        else:
            state = replace(state, system=after.system) if secant else state
            damping = max(damping, 1e-3) * 10
        if abs(gain) < max(tuning.MIN_GAIN, MIN_GAIN_SHARE * fitter.cost(state)):
            break
    return state


def _refine_fit(fitter: _Fitter, state: _State, fine: Predict | None, on_step: Callable[[str], None]) -> Fit:
    """Corrects the fit by the differences between a finer simulation and the coarse one, and adds the intervals."""
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
        # Errors of the series may cancel in this sum, but not in that of their remainders. Remaining creep has the same
        # sign in all series, and so has the error of the finest mesh: these do not average out.
        apart = np.sqrt((fit.parameter_changes(off, series) ** 2).sum(axis=0))
        fit = replace(
            fit, mesh_shift=np.maximum(np.abs(shift), apart), settled_shift=fit.parameter_changes(settled, series)
        )  # fmt: skip
    noisier = fit.with_sigma(fitter.sigma * max(1.0, np.sqrt(scatter)))
    return replace(fit, covariance=noisier.covariance).widen_intervals(residual, series)

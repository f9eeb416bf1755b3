"""Three measures of how well a policy can distinguish frames of two sources.

**rho**: the distance of a press to its partner, over the distance of two neighbouring presses of B. Below 1 the change
of source has a smaller effect than the next press. **AUC**: area under the curve of a linear classifier of the sources
on left-out presses; 1/2 is chance. **Drift**: increase of the gradient error when B's light changes, with a fresh and
with a stale reference.

Distances are those of a patch of fixed size around the contact, in four views: the raw picture, its difference from the
reference without drift of the light (the input of a policy), gradient, height.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.bundle import Calibration
from calibration.compare import metrics
from calibration.compare.compare import BOOTSTRAP_DRAWS, Comparison
from calibration.compare.scorer import GRID, estimate_surfaces
from calibration.errors import BadFrames
from calibration.reference import subtract_drift
from tacsim.control import MIN_CONTACT_HEIGHT
from tacsim.interface import FloatArray, Image

PATCH_SIDE = 5.2e-3  # if pixels have a known pitch [m]
MIN_PRESSES = 4

VIEWS = ("raw", "difference", "gradient", "height")


@dataclass(frozen=True, slots=True)
class Invariance:
    """The measures in one view."""

    view: str
    signal: float  # mean norm of a patch's change by contact, in the view's own unit
    distance: float  # median distance of A and B, over the signal
    neighbour: float  # median distance of presses of B that are neighbours in size, over the signal
    rho: float  # distance / neighbour
    rho_low: float  # 95 % interval, by bootstrap over presses
    rho_high: float
    auc: float  # of a linear classifier on left-out presses
    auc_low: float
    auc_high: float


@dataclass(frozen=True, slots=True)
class Change:
    """A change of a camera's light and gain, as grey = gain * grey + offset for R, G, B, clipped to 0..255."""

    name: str
    key: str
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    offset: float = 0.0  # [grey levels]

    def __call__(self, image: Image) -> Image:
        changed = image * np.array(self.gain, dtype=np.float32) + np.float32(self.offset)
        grey: Image = np.rint(np.clip(changed, 0, 255)).astype(np.uint8)
        return grey


CHANGES = (
    Change("gain −30 %", "gain_down", (0.7, 0.7, 0.7)),
    Change("gain +20 %", "gain_up", (1.2, 1.2, 1.2)),
    Change("white balance R +20 %, B −15 %", "white_balance", (1.2, 1.0, 0.85)),
    Change("offset +15", "offset", offset=15.0),
)


@dataclass(frozen=True, slots=True)
class DriftError:
    """Gradient angle error against A where pressed, beyond that without change [degrees]; mean over presses."""

    change: Change
    fresh: float  # with a reference taken after the change
    stale: float  # with the one from before; NaN, as fresh, where no surface is found


@dataclass(frozen=True, slots=True)
class Report:
    """All measures of invariance."""

    presses: int
    views: tuple[Invariance, ...]
    patch: str  # description of its size
    angle: float  # gradient angle error against A without any change [degrees]; NaN without surfaces
    drifts: tuple[DriftError, ...]
    notes: tuple[str, ...]


def measure_invariance(
    folds: Sequence[tuple[Comparison, Calibration | None]],
    on_step: Callable[[int, int], None] = lambda done, total: None,
) -> Report:
    """Measures of finished comparisons, each with B's calibration (needed for drifts): of one, or of parts of one set
    of presses, each left out of its calibration. Gradient and height need surfaces on both sides.

    Raises BadFrames for fewer than MIN_PRESSES with contact in B.
    """
    touched = [
        {
            k: pair.contact_b
            for k, pair in enumerate(comparison.pairs)
            if pair.contact_b is not None and (comparison.surfaces_a is None or comparison.surfaces(k) is not None)
        }
        for comparison, _ in folds
    ]
    count = sum(map(len, touched))
    if count < MIN_PRESSES:
        raise BadFrames(
            f"{count} pairs show contact in B; {MIN_PRESSES} are needed to estimate the distance of two presses"
        )
    radii = [patch.radius for one in touched for patch in one.values()]
    half, words = _patch_size(folds[0][1], radii)
    parts = [
        _cut_patches(comparison, one, calibration, half)
        for (comparison, calibration), one in zip(folds, touched, strict=True)
        if one
    ]
    common = [name for name in VIEWS if all(name in part for part in parts)]
    steps = len(common) + len(CHANGES)
    views: list[Invariance] = []
    for name in common:
        on_step(len(views), steps)
        of_a, of_b = (np.concatenate([part[name][side] for part in parts]) for side in (0, 1))
        signal = float(np.mean(np.concatenate([part[name][2] for part in parts])))
        views.append(_measure_view(name, of_a, of_b, signal, np.argsort(radii)))
    notes = [] if "height" in common else ["gradient and height are left out: no surfaces on both sides"]
    angle = math.nan
    drifts: list[DriftError] = []
    if any(comparison.surfaces_a is None or calibration is None for comparison, calibration in folds):
        notes.append("no drift table: it needs surfaces of A and the calibration of B")
    else:
        angle = _mean_gradient_angle(folds, touched, None, None)
        for k, change in enumerate(CHANGES):
            on_step(len(views) + k, steps)
            fresh = _mean_gradient_angle(folds, touched, change, change)
            stale = _mean_gradient_angle(folds, touched, change, None)
            drifts.append(DriftError(change, fresh - angle, stale - angle))
        if lost := [drift.change.name for drift in drifts if math.isnan(drift.stale) or math.isnan(drift.fresh)]:
            notes.append(f"no surface of B is found, so no drift is measured, after: {'; '.join(lost)}")
    return Report(count, tuple(views), words, angle, tuple(drifts), tuple(notes))


def partner_distances(of_a: FloatArray, of_b: FloatArray, order: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
    """(n,) of rows (n, d) of A and B that are partners, and (n - 1,) of rows of B that are neighbours in `order`."""
    return np.linalg.norm(of_a - of_b, axis=1), np.linalg.norm(np.diff(of_b[order], axis=0), axis=1)


def classifier_scores(of_a: FloatArray, of_b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n,) scores of the presses of A and of B, each by a linear classifier trained without that press in either
    source: ridge regression on -1 and 1 in the first principal components, standardised."""
    max_folds = 20  # up to this number of presses, each is left out alone
    weight = 1.0
    component_count = 6  # principal components of the classifier
    count = len(of_a)
    rows = np.concatenate([of_a, of_b])
    wanted = np.repeat([-1.0, 1.0], count)
    fold = np.tile(np.arange(count) % min(count, max_folds), 2)
    scores = np.zeros(2 * count)
    for number in range(min(count, max_folds)):
        held = fold == number
        middle = rows[~held].mean(axis=0)
        away = rows - middle
        # principal components through the products of the few presses, not of their many pixels
        _, vectors = np.linalg.eigh(away[~held] @ away[~held].T)
        seen = away @ (away[~held].T @ vectors[:, : -component_count - 1 : -1])
        spread = seen[~held].std(axis=0)
        seen = np.column_stack([seen / np.where(spread > 0, spread, 1.0), np.ones(len(seen))])
        square = seen[~held].T @ seen[~held] + weight * np.eye(seen.shape[1])
        scores[held] = seen[held] @ np.linalg.solve(square, seen[~held].T @ wanted[~held])
    return scores[:count], scores[count:]


def area_under_curve(low: FloatArray, high: FloatArray, weight: FloatArray | None = None) -> FloatArray:
    """Probability that a score of `high` (n,) is above one of `low` (n,); ties count half (Mann and Whitney). weight:
    (..., n) weight of each press; default: 1."""
    above = (high[:, None] > low[None, :]) + 0.5 * (high[:, None] == low[None, :])
    times = np.ones(len(low)) if weight is None else weight
    return np.asarray(((times @ above) * times).sum(axis=-1) / times.sum(axis=-1) ** 2)


def auc_interval(low: FloatArray, high: FloatArray, times: FloatArray) -> tuple[float, float]:
    """95 % interval of :func:`area_under_curve` by bootstrap. times: (draws, n) number of times each press is drawn.

    A press that is drawn twice is compared with its own partner twice as often as in the estimate. That shifts all
    draws equally, so they are shifted back to the estimate. The interval then contains a known area in 92 to 97 % of
    draws.
    """
    areas = area_under_curve(low, high, times)
    areas = np.clip(areas + area_under_curve(low, high) - areas.mean(), 0.0, 1.0)
    below, above = np.percentile(areas, (2.5, 97.5))
    return float(below), float(above)


def _measure_view(name: str, of_a: FloatArray, of_b: FloatArray, signal: float, order: NDArray[np.intp]) -> Invariance:
    rng = np.random.default_rng(0)
    count = len(of_a)
    score_a, score_b = classifier_scores(of_a, of_b)
    to_partner, steps = partner_distances(of_a, of_b, order)
    apart, step = float(np.median(to_partner)), float(np.median(steps))
    drawn = rng.integers(0, count, (BOOTSTRAP_DRAWS, count))
    below = np.median(steps[rng.integers(0, count - 1, (BOOTSTRAP_DRAWS, count - 1))], axis=1)
    rho_low, rho_high = np.percentile(np.median(to_partner[drawn], axis=1) / np.maximum(below, 1e-30), (2.5, 97.5))
    times = np.stack([(drawn == press).sum(axis=1) for press in range(count)], axis=1).astype(np.float64)
    auc = float(area_under_curve(score_a, score_b))
    auc_low, auc_high = auc_interval(score_a, score_b, times)
    return Invariance(
        view=name,
        signal=signal,
        distance=apart / signal if signal > 0 else math.nan,
        neighbour=step / signal if signal > 0 else math.nan,
        rho=apart / step if step > 0 else math.nan,
        rho_low=float(rho_low),
        rho_high=float(rho_high),
        auc=auc,
        auc_low=auc_low,
        auc_high=auc_high,
    )


def _patch_size(calibration: Calibration | None, radii: Sequence[float]) -> tuple[float, str]:
    """Half the side of the patch [px], and a description of its size."""
    side_in_radii = 3.0  # ... and else [radii of the median contact region]
    if calibration is not None:
        return PATCH_SIDE / 2 / calibration.geometry.pixel_pitch, f"{PATCH_SIDE * 1e3:g} mm"
    half = side_in_radii / 2 * float(np.median(radii))
    return half, f"{2 * half:.0f} px: {side_in_radii:g} radii of the usual contact region"


def _cut_patches(
    comparison: Comparison,
    touched: dict[int, metrics.Patch],
    calibration: Calibration | None,
    half: float,
) -> dict[str, tuple[FloatArray, FloatArray, FloatArray]]:
    """The patches (n, d) of A and of B, and the norms (n,) of B's change, for each view."""
    found: dict[str, tuple[list[FloatArray], list[FloatArray], list[float]]] = {view: ([], [], []) for view in VIEWS}
    a0, b0 = comparison.alignment(comparison.a.reference), comparison.b.reference.astype(np.float32)
    level = b0.mean(axis=(0, 1))
    for k, patch in touched.items():
        pair, x, y = comparison.pairs[k], patch.x, patch.y
        seen_a, seen_b = comparison.alignment(pair.a.image), pair.b.image.astype(np.float32)
        still = _cut_patch(b0, x, y, half)
        differences = subtract_drift(seen_a - a0, level), subtract_drift(seen_b - b0, level)
        for view, one, other in (("raw", seen_a, seen_b), ("difference", *differences)):
            cut = _cut_patch(other, x, y, half)
            zero = still if view == "raw" else 0.0
            _add_patches(found[view], _cut_patch(one, x, y, half), cut, cut - zero)
        surfaces = comparison.surfaces(k)
        if surfaces is None:
            continue
        at_x, at_y, reach = _patch_in_cells(comparison, k, calibration, x, y)
        surface_a, surface_b = surfaces
        for view, one, other in (
            ("gradient", surface_a.gradient, surface_b.gradient),
            ("height", surface_a.height, surface_b.height),
        ):
            cut = _cut_patch(other, at_x, at_y, reach)
            _add_patches(found[view], _cut_patch(one, at_x, at_y, reach), cut, cut)
    return {
        view: (np.array(of_a), np.array(of_b), np.array(signals))
        for view, (of_a, of_b, signals) in found.items()
        if of_a
    }


def _add_patches(
    to: tuple[list[FloatArray], list[FloatArray], list[float]], a: FloatArray, b: FloatArray, change: FloatArray
) -> None:
    to[0].append(a)
    to[1].append(b)
    to[2].append(float(np.linalg.norm(change)))


def _patch_in_cells(
    comparison: Comparison, k: int, calibration: Calibration | None, x: float, y: float
) -> tuple[float, float, float]:
    """Centre of the patch of pair k on the canonical grid, and half its side [cells]."""
    reach = PATCH_SIDE / 2 / GRID.pitch
    if calibration is None:  # both surfaces were recorded
        surfaces = comparison.surfaces(k)
        assert surfaces is not None
        patch = metrics.circle_of_region(metrics.pressed_region(surfaces[1].height, MIN_CONTACT_HEIGHT))
        return (patch.x, patch.y, reach) if patch is not None else (GRID.columns / 2, GRID.rows / 2, reach)
    u0, v0 = calibration.geometry.principal
    scale = calibration.geometry.pixel_pitch / GRID.pitch
    return (x - u0) * scale + (GRID.columns - 1) / 2, (y - v0) * scale + (GRID.rows - 1) / 2, reach


def _cut_patch(field: NDArray[np.float32], x: float, y: float, half: float) -> FloatArray:
    """(d,) values of a square patch of a field (H, W[, n]), up to `half` from x, y along each axis."""
    patch_points = 36  # along each axis
    import cv2

    line = np.linspace(-half, half, patch_points)
    u, v = (points.astype(np.float32) for points in np.meshgrid(x + line, y + line))
    picture = np.ascontiguousarray(field, dtype=np.float32)
    spacing = 2 * half / (patch_points - 1)
    if spacing > 1.0:  # a patch of many pixels: else every few of them would decide
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.5 * spacing), dtype=np.float32)
    cut = cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(cut, dtype=np.float64).ravel()


def _mean_gradient_angle(
    folds: Sequence[tuple[Comparison, Calibration | None]],
    touched: Sequence[dict[int, metrics.Patch]],
    change: Change | None,
    of_reference: Change | None,
) -> float:
    """Mean gradient angle error of B's changed frames against A's surfaces in the pressed region [degrees]; NaN without
    a surface."""
    angles: list[float] = []
    for (comparison, calibration), one in zip(folds, touched, strict=True):
        assert comparison.surfaces_a is not None
        truth = [comparison.surfaces_a[k] for k in one]
        reference = comparison.b.reference if of_reference is None else of_reference(comparison.b.reference)
        real = [comparison.pairs[k].b for k in one]
        frames = [replace(frame, image=frame.image if change is None else change(frame.image)) for frame in real]
        found, _ = estimate_surfaces(replace(comparison.b, reference=reference), frames, calibration)
        assert found is not None  # there is a calibration
        angles += [
            metrics.mean_normal_angle(
                seen.gradient, other.gradient, metrics.pressed_region(seen.height, MIN_CONTACT_HEIGHT) & other.valid
            )
            for seen, other in zip(truth, found, strict=True)
            if seen is not None and other is not None
        ]
    measured = [angle for angle in angles if not math.isnan(angle)]
    return float(np.mean(measured)) if measured else math.nan

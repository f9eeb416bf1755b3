"""Similarity of the frames of two sensors: simulated against real, or any two.

B is the reference. Each number has two others for comparison. The *null* is the result for a picture without contact,
A's reference in place of A. The *floor* is the result of noise alone, from two pictures of the untouched gel. A
simulation is useful if it is significantly better than the null, and perfect if it reaches the floor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from calibration.bundle import Calibration
from calibration.compare import metrics
from calibration.compare.metrics import Alignment, align_by_geometry, align_by_size, find_shift
from calibration.compare.scorer import (
    GRID,
    Numbers,
    Pair,
    Scorer,
    SurfaceEstimate,
    estimate_surfaces,
    surface_errors,
    undeformed_surface,
)
from calibration.errors import BadFrames
from calibration.frame_set import Frame, FrameSet, find_touched_references
from calibration.reference import subtract_drift
from tacsim.control import MIN_CONTACT_HEIGHT
from tacsim.interface import FloatArray, Image
from tacsim.record.numbering import numbers_in_names

BOOTSTRAP_DRAWS = 2000
MIN_PAIRS = 3  # for an interval


class Pairing(StrEnum):
    """How frames of A are paired with frames of B."""

    auto = "auto"  # by name where all names are the same, else in order
    name = "name"  # by name, those that only one side has are left out
    order = "order"


@dataclass(frozen=True, slots=True)
class Metric:
    """One number for each pair."""

    key: str
    label: str
    unit: str = ""
    scale: float = 1.0  # shown in `unit` as value times this; files and thresholds have SI units, degrees and pixels
    digits: int = 2
    more_is_better: bool = False

    @property
    def si(self) -> str:
        """The unit in files."""
        return "m" if self.unit == "mm" else "" if self.unit == "%" else self.unit


METRICS = (
    Metric("mae", "MAE", "grey"),
    Metric("psnr", "PSNR", "dB", more_is_better=True, digits=1),
    Metric("ssim", "SSIM", digits=3, more_is_better=True),
    Metric("contact_mae", "contact MAE", "grey"),
    Metric("contact_psnr", "contact PSNR", "dB", more_is_better=True, digits=1),
    Metric("contact_ssim", "contact SSIM", digits=3, more_is_better=True),
    Metric("contact_ncc", "contact NCC of the difference", digits=3, more_is_better=True),
    Metric("contact_iou", "contact IoU", digits=3, more_is_better=True),
    Metric("contact_radius", "contact radius error", "px"),
    Metric("contact_centroid", "contact centroid error", "px"),
    Metric("grain", "grain error outside contact", "grey"),
    Metric("contact_grain", "grain error in contact", "grey"),
    Metric("gradient_angle", "gradient angle error", "°"),
    Metric("height_rmse", "height RMSE", "mm", 1e3, 4),
    Metric("height_share", "height RMSE of indentation", "%", 1e2, 1),
    Metric("surface_iou", "pressed area IoU", digits=3, more_is_better=True),
    Metric("surface_radius", "pressed radius error", "mm", 1e3, 3),
    Metric("surface_centroid", "pressed centroid error", "mm", 1e3, 3),
    Metric("marker_error", "marker end-point error", "mm", 1e3, 4),
)


@dataclass(frozen=True, slots=True)
class Overall:
    """One metric over all pairs. Unknown values are NaN."""

    mean: float
    low: float  # 95 % interval of the mean, by bootstrap over pairs
    high: float
    null: float
    floor: float
    better: float  # share of the pairs that are better than their null
    outperforms_null: bool | None  # significantly, over all pairs; None: too few pairs


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """The whole result."""

    a: FrameSet
    b: FrameSet
    alignment: Alignment
    pairs: tuple[Pair, ...]
    overall: dict[str, Overall]
    notes: tuple[str, ...]
    names: tuple[str, str] = ("A", "B")  # or "simulated", "real": see :func:`side_names`
    surfaces_a: tuple[SurfaceEstimate | None, ...] | None = None  # surfaces of the pairs, aligned; None: not known
    surfaces_b: tuple[SurfaceEstimate | None, ...] | None = None

    def surfaces(self, k: int) -> tuple[SurfaceEstimate, SurfaceEstimate] | None:
        """The surfaces of A and B in pair `k`; None if either is not known."""
        a, b = (None if side is None else side[k] for side in (self.surfaces_a, self.surfaces_b))
        return None if a is None or b is None else (a, b)

    def aligned(self, image: Image) -> Image:
        """A picture of A in the pixels of B."""
        return np.rint(self.alignment(image)).astype(np.uint8)


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a comparison."""

    pairing: Pairing = Pairing.auto
    shift: bool | None = None  # look for the shift between the two; None: unless A is made in the pixels of B


DEFAULT_OPTIONS = Options()


def compare_frames(
    a: FrameSet,
    b: FrameSet,
    calibration_a: Calibration | None = None,
    calibration_b: Calibration | None = None,
    options: Options = DEFAULT_OPTIONS,
    on_pair: Callable[[int, int], None] = lambda done, total: None,
) -> Comparison:
    """Compares A with B.

    A calibration gives the positions of a side's pixels on the gel, and height and gradient from its pictures; without
    one, the recorded surfaces of a simulation are used. on_pair: is called with the numbers of finished and of all
    pairs. Raises BadFrames.
    """
    names = side_names(a, b)
    frame_pairs, left = pair_frames(a, b, options.pairing)
    shift = not a.same_pixels if options.shift is None else options.shift
    alignment = _find_alignment(a, b, frame_pairs, calibration_a, calibration_b, shift=shift)
    notes: list[str] = [*a.notes, *b.notes, *find_touched_references(a), *find_touched_references(b)]
    found_a, said_a = estimate_surfaces(a, [frame for frame, _ in frame_pairs], calibration_a)
    found_b, said_b = estimate_surfaces(b, [frame for _, frame in frame_pairs], calibration_b)
    if found_a is not None and found_b is not None and calibration_b is not None:
        moved = np.array(alignment.shift) * calibration_b.geometry.pixel_pitch / GRID.pitch
        found_a = tuple(None if each is None else each.moved(moved) for each in found_a)
    elif found_a is not None and found_b is not None and max(map(abs, alignment.shift)) > 0.5:
        notes.append("surfaces are compared as they were recorded, without the shift: it is known in pixels only")
    if found_a is None or found_b is None:
        said = zip(names, (said_a, said_b), strict=True)
        notes += [f"no surfaces are compared: {side}: {why}" for side, why in said if why]
        found_a = found_b = None
    else:
        unknown = zip(names, (said_a, said_b), strict=True)
        notes += [f"{side}: no surface where nothing can be measured: {why}" for side, why in unknown if why]
    scorer = Scorer(a, b, alignment, names)
    pairs = []
    for k, (frame_a, frame_b) in enumerate(frame_pairs):
        on_pair(k, len(frame_pairs))
        surface_a, surface_b = (None if found is None else found[k] for found in (found_a, found_b))
        pairs.append(scorer.score_pair(frame_a, frame_b, surface_a, surface_b))
    floor, of_floor = _noise_floor(scorer, b, pairs, calibration_b)
    overall = {metric.key: _summarise_metric(metric, pairs, floor.get(metric.key, math.nan)) for metric in METRICS}
    notes += [*left, *of_floor, *scorer.swap_warning()]
    if len(pairs) < MIN_PAIRS:
        words = "pair" if len(pairs) == 1 else "pairs"
        notes.append(f"{len(pairs)} {words}: too few for intervals; at least {MIN_PAIRS} are needed")
    return Comparison(a, b, alignment, tuple(pairs), overall, tuple(notes), names, found_a, found_b)


def side_names(a: FrameSet, b: FrameSet) -> tuple[str, str]:
    """Names of the two sides: simulated and real if exactly one is known to be simulated, else A and B."""
    if a.simulated == b.simulated:
        return "A", "B"
    return ("simulated", "real") if a.simulated else ("real", "simulated")


def pair_frames(a: FrameSet, b: FrameSet, pairing: Pairing) -> tuple[list[tuple[Frame, Frame]], list[str]]:
    """The pairs of frames, and notes on frames without a partner. Raises BadFrames if the pairing is ambiguous."""
    named_a, named_b = ({Path(frame.name).stem.lower(): frame for frame in each.frames} for each in (a, b))
    common = [name for name in named_a if name in named_b]
    if a.same_pixels and pairing is Pairing.auto:  # it says itself what it could not make
        if not common:
            raise BadFrames(f"{a.name}: none of its frames could be made. " + "; ".join(a.notes))
        return [(named_a[name], named_b[name]) for name in common], []
    same = len(common) == len(a.frames) == len(b.frames)
    if pairing is Pairing.name or (pairing is Pairing.auto and same):
        if not common:
            raise BadFrames(f"no frame of {a.name} has the name of one of {b.name}; pair them in order (--pair order)")
        rest = len(a.frames) + len(b.frames) - 2 * len(common)
        said = [f"{rest} frames have no partner of their name and are left out"] if rest else []
        return [(named_a[name], named_b[name]) for name in common], said
    if len(a.frames) != len(b.frames):
        raise BadFrames(
            f"{a.name} has {len(a.frames)} frames, {b.name} {len(b.frames)}: which belong together? {len(common)} "
            "names are in both; pair these alone with --pair name, or give both the same number of frames"
        )
    if pairing is Pairing.auto and (odd := _describe_unpaired(a, b)):
        raise BadFrames(
            f"{odd}: a picture may be missing, and which belong together? Pair those with a name in common by --pair "
            "name, or, if the first belongs to the first and so on, say --pair order"
        )
    return list(zip(a.frames, b.frames, strict=True)), ["paired in order: the names differ"] if not same else []


def _describe_unpaired(a: FrameSet, b: FrameSet) -> str:
    """Description of the picture numbers that only one of two folders has; empty if both have the same or no common
    numbers, or if the names are not numbered."""
    names = [[Path(frame.name) for frame in each.frames] for each in (a, b)]
    if not all(name.suffix for each in names for name in each):
        return ""
    found = [numbers_in_names([name.stem for name in each]) for each in names]
    first, second = ({number for number in each or () if number is not None} for each in found)
    unnumbered = any(each is None or None in each for each in found)
    if unnumbered or first == second or not first & second:
        return ""
    parts = [
        f"{side.name} alone has number {', '.join(map(str, sorted(rest)[:8]))}{', ...' * (len(rest) > 8)}"
        for side, rest in ((a, first - second), (b, second - first))
        if rest
    ]
    return "; ".join(parts)


def bootstrap_interval(values: FloatArray, seed: int = 0) -> tuple[float, float]:
    """95 % interval of the mean of values (n,), by resampling; NaN for fewer than MIN_PAIRS."""
    if len(values) < MIN_PAIRS:
        return math.nan, math.nan
    rng = np.random.default_rng(seed)
    means = values[rng.integers(0, len(values), (BOOTSTRAP_DRAWS, len(values)))].mean(axis=1)
    low, high = np.percentile(means, (2.5, 97.5))
    return float(low), float(high)


def _find_alignment(
    a: FrameSet,
    b: FrameSet,
    frame_pairs: Sequence[tuple[Frame, Frame]],
    calibration_a: Calibration | None,
    calibration_b: Calibration | None,
    *,
    shift: bool,
) -> Alignment:
    max_shift_pairs = 40  # pairs from which the shift is found
    if calibration_a is not None and calibration_b is not None:
        alignment = align_by_geometry(calibration_a.geometry, calibration_b.geometry)
        for side, shape, said in ((a, alignment.source, "A"), (b, alignment.shape, "B")):
            if side.shape != shape:
                raise BadFrames(
                    f"{side.name} is {side.shape[1]} x {side.shape[0]} px, the calibration of {said} is of "
                    f"{shape[1]} x {shape[0]}; it belongs to another sensor or setting"
                )
    else:
        alignment = align_by_size(a.shape, b.shape)
    if not alignment.covered_mask.any():
        raise BadFrames("A shows no part of the gel that B shows; are these the right calibrations?")
    if not shift:
        return alignment.shifted((0.0, 0.0), "no shift is sought")
    chosen = frame_pairs if len(frame_pairs) <= max_shift_pairs else [
        frame_pairs[int(k)] for k in np.linspace(0, len(frame_pairs) - 1, max_shift_pairs)
    ]  # fmt: skip
    base_a, base_b = alignment(a.reference), b.reference.astype(np.float32)
    level = b.reference.mean(axis=(0, 1))
    changes = (
        (subtract_drift(alignment(one.image) - base_a, level), subtract_drift(other.image - base_b, level))
        for one, other in chosen
    )
    return find_shift(changes, alignment)


def _noise_floor(
    scorer: Scorer, b: FrameSet, pairs: Sequence[Pair], calibration: Calibration | None
) -> tuple[Numbers, list[str]]:
    """Metrics of pictures of B without contact against each other, in the contact regions of the pairs; and a note."""
    max_noise_frames = 5  # untouched frames from which the floor is made
    frames = [*b.untouched, *(pair.b for pair in pairs if not pair.region.any())][:max_noise_frames]
    touched = [pair for pair in pairs if pair.region.any()]
    if not frames or not touched:
        why = f"{scorer.names[1]} has no second frame without contact" if not frames else "no pair has contact"
        return {}, [f"noise floor absent: {why}"]
    floor = _mean_scores(
        [scorer.score_images(frame.image, b.reference, pair.region) for frame in frames for pair in touched]
    )
    found, _ = estimate_surfaces(b, frames, calibration)
    pressed, _ = estimate_surfaces(b, [pair.b for pair in touched], calibration)
    if found is not None and pressed is not None:
        known = [each for each in pressed if each is not None]
        regions = [metrics.pressed_region(each.height, MIN_CONTACT_HEIGHT) & each.valid for each in known]
        scores = [
            surface_errors(still, undeformed_surface(still), where, each)
            for still in found if still is not None
            for where, each in zip(regions, known, strict=True)
        ]  # fmt: skip
        floor |= _mean_scores(scores) if scores else {}
    return floor, [f"noise floor from {len(frames)} more frames of {scorer.names[1]} without contact"]


def _mean_scores(scores: Sequence[Numbers]) -> Numbers:
    return {key: _known_mean([score[key] for score in scores]) for key in scores[0]}


def _summarise_metric(metric: Metric, pairs: Sequence[Pair], floor: float) -> Overall:
    values, nulls = (
        np.array([numbers.get(metric.key, math.nan) for numbers in side])
        for side in ([pair.numbers for pair in pairs], [pair.null for pair in pairs])
    )
    known = values[np.isfinite(values)]
    both = np.isfinite(values) & np.isfinite(nulls)
    gain = (values[both] - nulls[both]) * (1.0 if metric.more_is_better else -1.0)
    surely = bootstrap_interval(gain)[0]
    low, high = bootstrap_interval(known)
    return Overall(
        mean=_known_mean(values),
        low=low,
        high=high,
        null=_known_mean(nulls),
        floor=floor,
        better=float((gain > 0).mean()) if gain.size else math.nan,
        outperforms_null=None if math.isnan(surely) else surely > 0,
    )


def _known_mean(values: Sequence[float] | FloatArray) -> float:
    """Mean of the known values; NaN without any. Infinite if one value is, as the PSNR of equal pictures."""
    array = np.asarray(values, dtype=np.float64)
    known = array[~np.isnan(array)]
    return float(known.mean()) if known.size else math.nan

"""How alike the frames of two sensors are: simulated against real, or any two.

B is taken for the truth. Every number stands beside two others. The *null* is what a picture without contact scores:
A's reference in A's place. The *floor* is what noise alone scores: a second picture of the untouched gel against the
first. A simulation is worth something where it is surely better than the null, and perfect where it reaches the floor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.bundle import Calibration
from calibration.compare import metrics
from calibration.compare.alignment import Alignment, by_geometry, by_size, find_shift
from calibration.compare.surfaces import SurfaceEstimate, estimate_surfaces, flat_surface
from calibration.errors import BadFrames
from calibration.frame_set import Frame, FrameSet, frame_warnings
from tacsim.control.contact_signal import CONTACT_HEIGHT
from tacsim.models.sensor import CanonicalGrid

Image = NDArray[np.uint8]
Float64 = NDArray[np.float64]
Mask = NDArray[np.bool_]
Numbers = dict[str, float]

MAX_SHIFT_PAIRS = 40  # pairs from which the shift is found
MAX_NOISE_FRAMES = 5  # untouched frames from which the floor is made
BOOTSTRAP_DRAWS = 2000
MIN_PAIRS = 3  # for an interval
GRID = CanonicalGrid()  # the usual one
SWAPPED_GAIN = 0.2  # of the correlation, by red and blue exchanged, that makes them look swapped


class Pairing(StrEnum):
    """Which frame of A belongs to which of B."""

    auto = "auto"  # by name where all names are the same, else in order
    name = "name"  # by name, those that only one side has are left out
    order = "order"


@dataclass(frozen=True, slots=True)
class Metric:
    """One number a pair."""

    key: str
    label: str
    unit: str = ""
    scale: float = 1.0  # shown in `unit` as value times this; files and thresholds have SI units, degrees and pixels
    digits: int = 2
    more_is_better: bool = False
    of_surface: bool = False  # needs height and gradient of both sides


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
    Metric("gradient_angle", "gradient angle error", "°", of_surface=True),
    Metric("height_rmse", "height RMSE", "mm", 1e3, 4, of_surface=True),
    Metric("height_share", "height RMSE of indentation", "%", 1e2, 1, of_surface=True),
    Metric("surface_iou", "pressed area IoU", digits=3, more_is_better=True, of_surface=True),
    Metric("surface_radius", "pressed radius error", "mm", 1e3, 3, of_surface=True),
    Metric("surface_centroid", "pressed centroid error", "mm", 1e3, 3, of_surface=True),
    Metric("marker_error", "marker end-point error", "mm", 1e3, 4, of_surface=True),
)


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """One frame of A against one of B."""

    a: Frame
    b: Frame
    numbers: Numbers
    null: Numbers  # the same of A's reference
    flags: tuple[str, ...]
    region: Mask  # (H, W) contact in either, in the pixels of B
    contact_b: metrics.Patch | None  # contact of B alone, in its pixels


@dataclass(frozen=True, slots=True)
class Overall:
    """One metric over all pairs. What is not known is NaN."""

    mean: float
    low: float  # 95 % interval of the mean, by bootstrap over pairs
    high: float
    null: float
    floor: float
    better: float  # share of the pairs that are better than their null
    beats_null: bool | None  # surely so, over all pairs; None: too few pairs


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """The whole result."""

    a: FrameSet
    b: FrameSet
    alignment: Alignment
    pairs: tuple[Pair, ...]
    overall: dict[str, Overall]
    notes: tuple[str, ...]
    surfaces_a: tuple[SurfaceEstimate, ...] | None = None  # surfaces of the pairs, aligned; None: not known
    surfaces_b: tuple[SurfaceEstimate, ...] | None = None

    def aligned(self, image: Image) -> Image:
        """A picture of A in the pixels of B."""
        return np.rint(self.alignment(image)).astype(np.uint8)


@dataclass(frozen=True, slots=True)
class Options:
    """How two sides are compared."""

    pairing: Pairing = Pairing.auto
    shift: bool = True  # look for the shift between the two
    grid: CanonicalGrid = GRID  # on which surfaces are compared


USUAL = Options()


def compare_frames(
    a: FrameSet,
    b: FrameSet,
    calibration_a: Calibration | None = None,
    calibration_b: Calibration | None = None,
    options: Options = USUAL,
    on_pair: Callable[[int, int], None] = lambda done, total: None,
) -> Comparison:
    """Compares A with B.

    A calibration says where a side's pixels lie on the gel, and finds height and gradient in its pictures; without one
    the surfaces that a simulation has recorded count. `on_pair` is given how many pairs are done, and
    how many there are. Raises BadFrames.
    """
    couples, left = paired(a, b, options.pairing)
    alignment = _alignment(a, b, couples, calibration_a, calibration_b, shift=options.shift)
    notes: list[str] = []
    grid = options.grid
    found_a, said_a = estimate_surfaces(a, [frame for frame, _ in couples], calibration_a, grid)
    found_b, said_b = estimate_surfaces(b, [frame for _, frame in couples], calibration_b, grid)
    if found_a is not None and found_b is not None and calibration_b is not None:
        moved = np.array(alignment.shift) * calibration_b.geometry.pixel_pitch / grid.pitch
        found_a = tuple(each.moved(moved) for each in found_a)
    elif found_a is not None and found_b is not None and max(map(abs, alignment.shift)) > 0.5:
        notes.append("surfaces are compared as they were recorded, without the shift: it is known in pixels only")
    if found_a is None or found_b is None:
        notes += [f"no surfaces are compared: {side}: {why}" for side, why in (("A", said_a), ("B", said_b)) if why]
        found_a = found_b = None
    scorer = _Scorer(a, b, alignment, grid)
    pairs = []
    for k, (frame_a, frame_b) in enumerate(couples):
        on_pair(k, len(couples))
        surface_a, surface_b = (None if found is None else found[k] for found in (found_a, found_b))
        pairs.append(scorer.pair(frame_a, frame_b, surface_a, surface_b))
    floor, said = _floor(scorer, b, pairs, calibration_b, options.grid)
    overall = {metric.key: _overall(metric, pairs, floor.get(metric.key, math.nan)) for metric in METRICS}
    notes += [*left, *said, *scorer.swapped()]
    if len(pairs) < MIN_PAIRS:
        words = "pair" if len(pairs) == 1 else "pairs"
        notes.append(f"{len(pairs)} {words}: too few for intervals; {MIN_PAIRS} are the least")
    return Comparison(a, b, alignment, tuple(pairs), overall, tuple(notes), found_a, found_b)


def paired(a: FrameSet, b: FrameSet, pairing: Pairing) -> tuple[list[tuple[Frame, Frame]], list[str]]:
    """The frames that belong together, and notes on those left out. Raises BadFrames where that is ambiguous."""
    named_a, named_b = ({Path(frame.name).stem.lower(): frame for frame in each.frames} for each in (a, b))
    common = [name for name in named_a if name in named_b]
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
    return list(zip(a.frames, b.frames, strict=True)), ["paired in order: the names differ"] if not same else []


def bootstrap(values: Float64, seed: int = 0) -> tuple[float, float]:
    """95 % interval of the mean of values (n,), by resampling; NaN for fewer than MIN_PAIRS."""
    if len(values) < MIN_PAIRS:
        return math.nan, math.nan
    rng = np.random.default_rng(seed)
    means = values[rng.integers(0, len(values), (BOOTSTRAP_DRAWS, len(values)))].mean(axis=1)
    low, high = np.percentile(means, (2.5, 97.5))
    return float(low), float(high)


class _Scorer:
    """Scores pairs in the pixels of B."""

    def __init__(self, a: FrameSet, b: FrameSet, alignment: Alignment, grid: CanonicalGrid) -> None:
        self._b, self._alignment, self._grid = b, alignment, grid
        self._covered = alignment.covered
        self._whole = None if self._covered.all() else self._covered
        self._reference_a = alignment(a.reference)
        self._plain: list[float] = []  # correlations of the pairs as they are, and with red and blue exchanged
        self._swapped: list[float] = []

    def pair(self, a: Frame, b: Frame, surface_a: SurfaceEstimate | None, surface_b: SurfaceEstimate | None) -> Pair:
        seen_a, seen_b = self._alignment(a.image), b.image.astype(np.float32)
        change_a, change_b = seen_a - self._reference_a, seen_b - self._b.reference
        contact_a, contact_b = (metrics.contact_region(change) & self._covered for change in (change_a, change_b))
        region = contact_a | contact_b
        numbers = self.pictures(seen_a, seen_b, region) | _contacts(contact_a, contact_b)
        numbers["contact_ncc"] = metrics.correlation(change_a, change_b, region)
        null = self.pictures(self._reference_a, seen_b, region) | _contacts(np.zeros_like(contact_b), contact_b)
        null["contact_ncc"] = metrics.correlation(np.zeros_like(change_b), change_b, region)
        if surface_a is not None and surface_b is not None:
            numbers |= self._surfaces(surface_a, surface_b, surface_a)
            null |= self._surfaces(flat_surface(surface_b), surface_b, surface_a)
        if region.any():
            self._plain.append(numbers["contact_ncc"])
            self._swapped.append(metrics.correlation(change_a[..., ::-1], change_b, region))
        reference_b = self._b.reference.astype(np.float32)
        flags = [
            *(f"A: {words}" for words in frame_warnings(seen_a, self._reference_a, contact_a)),
            *(f"B: {words}" for words in frame_warnings(seen_b, reference_b, contact_b)),
        ]
        return Pair(a, b, numbers, null, tuple(flags), region, metrics.patch_of(contact_b))

    def pictures(self, one: metrics.Picture, other: metrics.Picture, region: Mask) -> Numbers:
        """Of two pictures whose contact is `region`."""
        similarity = metrics.similarity_map(one, other)
        rim = metrics.WINDOW // 2
        inner = np.zeros_like(self._covered)
        inner[rim:-rim, rim:-rim] = True
        inner &= self._covered
        return {
            "mae": metrics.mean_absolute_error(one, other, self._whole),
            "psnr": metrics.peak_signal_to_noise(one, other, self._whole),
            "ssim": float(similarity[inner].mean()) if inner.any() else math.nan,
            "contact_mae": metrics.mean_absolute_error(one, other, region),
            "contact_psnr": metrics.peak_signal_to_noise(one, other, region),
            "contact_ssim": float(similarity[region].mean()) if region.any() else math.nan,
        }

    def _surfaces(self, a: SurfaceEstimate, b: SurfaceEstimate, shown: SurfaceEstimate) -> Numbers:
        """Of A's surface against B's, where B or `shown` is pressed."""
        pressed_a, pressed_b, of_shown = (metrics.pressed_region(t.height, CONTACT_HEIGHT) for t in (a, b, shown))
        pressed = _contacts(pressed_a, pressed_b)
        no_flow = a.flow is None or b.flow is None or a.flow.shape != b.flow.shape
        return surface_errors(a, b, (of_shown | pressed_b) & b.valid, b) | {
            "surface_iou": pressed["contact_iou"],
            "surface_radius": pressed["contact_radius"] * self._grid.pitch,
            "surface_centroid": pressed["contact_centroid"] * self._grid.pitch,
            "marker_error": math.nan if no_flow else metrics.end_point_error(np.asarray(a.flow), np.asarray(b.flow)),
        }

    def swapped(self) -> list[str]:
        """A warning if the pairs agree better with red and blue exchanged."""
        plain, swapped = (float(np.mean(values)) if values else 0.0 for values in (self._plain, self._swapped))
        if swapped > 0.5 and swapped > plain + SWAPPED_GAIN:
            return [
                f"red and blue look swapped in A or B: exchanged they correlate by {swapped:.2f}, as they are by "
                f"{plain:.2f}; OpenCV's pictures are BGR"
            ]
        return []


def surface_errors(a: SurfaceEstimate, b: SurfaceEstimate, where: Mask, pressed: SurfaceEstimate) -> Numbers:
    """Errors of gradient and height in a region (h, w); the share is of the depth of `pressed`."""
    error = metrics.height_error(a.height, b.height, where)
    deepest = float(pressed.height.max(initial=0.0))
    return {
        "gradient_angle": metrics.gradient_angle(a.gradient, b.gradient, where),
        "height_rmse": error,
        "height_share": error / deepest if deepest > CONTACT_HEIGHT else math.nan,
    }


def _contacts(a: Mask, b: Mask) -> Numbers:
    patch_a, patch_b = metrics.patch_of(a), metrics.patch_of(b)
    radius = abs((patch_a.radius if patch_a else 0.0) - (patch_b.radius if patch_b else 0.0))
    return {
        "contact_iou": metrics.overlap(a, b),
        "contact_radius": radius if patch_a or patch_b else math.nan,
        "contact_centroid": math.hypot(patch_a.x - patch_b.x, patch_a.y - patch_b.y)
        if patch_a and patch_b
        else math.nan,
    }


def _alignment(
    a: FrameSet,
    b: FrameSet,
    couples: Sequence[tuple[Frame, Frame]],
    calibration_a: Calibration | None,
    calibration_b: Calibration | None,
    *,
    shift: bool,
) -> Alignment:
    if calibration_a is not None and calibration_b is not None:
        alignment = by_geometry(calibration_a.geometry, calibration_b.geometry)
        for side, shape, said in ((a, alignment.source, "A"), (b, alignment.shape, "B")):
            if side.shape != shape:
                raise BadFrames(
                    f"{side.name} is {side.shape[1]} x {side.shape[0]} px, the calibration of {said} is of "
                    f"{shape[1]} x {shape[0]}; it belongs to another sensor or setting"
                )
    else:
        alignment = by_size(a.shape, b.shape)
    if not alignment.covered.any():
        raise BadFrames("A shows no part of the gel that B shows; are these the right calibrations?")
    if not shift:
        return alignment
    chosen = couples if len(couples) <= MAX_SHIFT_PAIRS else [
        couples[int(k)] for k in np.linspace(0, len(couples) - 1, MAX_SHIFT_PAIRS)
    ]  # fmt: skip
    base_a, base_b = alignment(a.reference), b.reference.astype(np.float32)
    changes = ((alignment(one.image) - base_a, other.image - base_b) for one, other in chosen)
    return find_shift(changes, alignment)


def _floor(
    scorer: _Scorer, b: FrameSet, pairs: Sequence[Pair], calibration: Calibration | None, grid: CanonicalGrid
) -> tuple[Numbers, list[str]]:
    """What pictures of B without contact score against each other, where the pairs have contact; and a note."""
    frames = [*b.untouched, *(pair.b for pair in pairs if not pair.region.any())][:MAX_NOISE_FRAMES]
    touched = [pair for pair in pairs if pair.region.any()]
    if not frames or not touched:
        why = "B has no second frame without contact" if not frames else "no pair has contact"
        return {}, [f"noise floor absent: {why}"]
    floor = _means([scorer.pictures(frame.image, b.reference, pair.region) for frame in frames for pair in touched])
    found, _ = estimate_surfaces(b, frames, calibration, grid)
    pressed, _ = estimate_surfaces(b, [pair.b for pair in touched], calibration, grid)
    if found is not None and pressed is not None:
        regions = [metrics.pressed_region(each.height, CONTACT_HEIGHT) & each.valid for each in pressed]
        floor |= _means([
            surface_errors(still, flat_surface(still), where, each)
            for still in found
            for where, each in zip(regions, pressed, strict=True)
        ])  # fmt: skip
    return floor, [f"noise floor from {len(frames)} more frames of B without contact"]


def _means(scores: Sequence[Numbers]) -> Numbers:
    return {key: _mean([score[key] for score in scores]) for key in scores[0]}


def _overall(metric: Metric, pairs: Sequence[Pair], floor: float) -> Overall:
    values, nulls = (
        np.array([numbers.get(metric.key, math.nan) for numbers in side])
        for side in ([pair.numbers for pair in pairs], [pair.null for pair in pairs])
    )
    known = values[np.isfinite(values)]
    both = np.isfinite(values) & np.isfinite(nulls)
    gain = (values - nulls)[both] * (1.0 if metric.more_is_better else -1.0)
    surely = bootstrap(gain)[0]
    low, high = bootstrap(known)
    return Overall(
        mean=_mean(values),
        low=low,
        high=high,
        null=_mean(nulls),
        floor=floor,
        better=float((gain > 0).mean()) if gain.size else math.nan,
        beats_null=None if math.isnan(surely) else surely > 0,
    )


def _mean(values: Sequence[float] | Float64) -> float:
    """Mean of what is known; NaN if nothing is. Infinite where one is: the PSNR of equal pictures."""
    array = np.asarray(values, dtype=np.float64)
    known = array[~np.isnan(array)]
    return float(known.mean()) if known.size else math.nan

"""How alike the frames of two sensors are: simulated against real, or any two.

Every number stands beside two others. The *null* is what a picture without contact scores: A's reference in A's place.
The *floor* is what a second picture of the untouched gel scores against the first: what noise alone makes. A
simulation is worth something where it is surely better than the null, and perfect where it reaches the floor.
B is taken for the truth.
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

LOOKED_AT = 40  # pairs that the shift is found from, at most
NOISE_FRAMES = 5  # untouched frames that the floor is made from, at most
DRAWS = 2000  # of the bootstrap
FEWEST = 3  # pairs: fewer have no interval
GRID = CanonicalGrid()  # the usual one
SWAPPED = 0.2  # by so much, red and blue exchanged must correlate better to be called so


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
    beats_null: bool | None  # surely so, over all pairs; None: too few to tell


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
    the surfaces that a simulation has recorded count. `on_pair` hears of progress. Raises BadFrames.
    """
    couples, left = paired(a, b, options.pairing)
    alignment, notes = _alignment(a, b, couples, calibration_a, calibration_b, shift=options.shift)
    grid = options.grid
    found_a, said_a = estimate_surfaces(a, [shot for shot, _ in couples], calibration_a, grid)
    found_b, said_b = estimate_surfaces(b, [shot for _, shot in couples], calibration_b, grid)
    if found_a is not None and found_b is not None and calibration_b is not None:
        moved = np.array(alignment.shift) * calibration_b.geometry.pixel_pitch / grid.pitch
        found_a = tuple(touch.moved(moved) for touch in found_a)
    elif found_a is not None and found_b is not None and max(map(abs, alignment.shift)) > 0.5:
        notes.append("surfaces are compared as they were recorded, without the shift: it is known in pixels only")
    if found_a is None or found_b is None:
        notes += [f"no surfaces are compared: {side}: {why}" for side, why in (("A", said_a), ("B", said_b)) if why]
        found_a = found_b = None
    judge = _Judge(a, b, alignment, grid)
    pairs = []
    for k, (shot_a, shot_b) in enumerate(couples):
        on_pair(k, len(couples))
        touch_a, touch_b = (None if found is None else found[k] for found in (found_a, found_b))
        pairs.append(judge.pair(shot_a, shot_b, touch_a, touch_b))
    floor, said = _floor(judge, b, pairs, calibration_b, options.grid)
    overall = {metric.key: _overall(metric, pairs, floor.get(metric.key, math.nan)) for metric in METRICS}
    notes += [*left, *said, *judge.swapped(), *_few(len(pairs))]
    return Comparison(a, b, alignment, tuple(pairs), overall, tuple(notes), found_a, found_b)


def paired(a: FrameSet, b: FrameSet, pairing: Pairing) -> tuple[list[tuple[Frame, Frame]], list[str]]:
    """The frames that belong together, and in words which were left out. Raises BadFrames when that cannot be told."""
    named_a, named_b = ({Path(shot.name).stem.lower(): shot for shot in side.frames} for side in (a, b))
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
    """95 % interval of the mean of values (n,), by resampling; NaN for fewer than FEWEST."""
    if len(values) < FEWEST:
        return math.nan, math.nan
    rng = np.random.default_rng(seed)
    means = values[rng.integers(0, len(values), (DRAWS, len(values)))].mean(axis=1)
    low, high = np.percentile(means, (2.5, 97.5))
    return float(low), float(high)


class _Judge:
    """Scores pairs in the pixels of B."""

    def __init__(self, a: FrameSet, b: FrameSet, alignment: Alignment, grid: CanonicalGrid) -> None:
        self._b, self._alignment, self._grid = b, alignment, grid
        self._covered = alignment.covered
        self._whole = None if self._covered.all() else self._covered
        self._reference_a = alignment(a.reference)
        self._plain: list[float] = []  # correlations of the pairs as they are, and with red and blue exchanged
        self._swapped: list[float] = []

    def pair(self, a: Frame, b: Frame, touch_a: SurfaceEstimate | None, touch_b: SurfaceEstimate | None) -> Pair:
        seen_a, seen_b = self._alignment(a.image), b.image.astype(np.float32)
        change_a, change_b = seen_a - self._reference_a, seen_b - self._b.reference
        contact_a, contact_b = (metrics.contact_region(change) & self._covered for change in (change_a, change_b))
        region = contact_a | contact_b
        numbers = self._pictures(seen_a, seen_b, region) | _contacts(contact_a, contact_b)
        numbers["contact_ncc"] = metrics.correlation(change_a, change_b, region)
        none = np.zeros_like(contact_b)
        null = self._pictures(self._reference_a, seen_b, region) | _contacts(none, contact_b)
        null["contact_ncc"] = metrics.correlation(np.zeros_like(change_b), change_b, region)
        if touch_a is not None and touch_b is not None:
            numbers |= self.surfaces(touch_a, touch_b, touch_a)
            null |= self.surfaces(flat_surface(touch_b), touch_b, touch_a)
        if region.any():
            self._plain.append(numbers["contact_ncc"])
            self._swapped.append(metrics.correlation(change_a[..., ::-1], change_b, region))
        reference_b = self._b.reference.astype(np.float32)
        flags = [
            *(f"A: {words}" for words in frame_warnings(seen_a, self._reference_a, contact_a)),
            *(f"B: {words}" for words in frame_warnings(seen_b, reference_b, contact_b)),
        ]
        return Pair(a, b, numbers, null, tuple(flags), region, metrics.patch_of(contact_b))

    def against_reference(self, shot: Frame, region: Mask) -> Numbers:
        """An untouched frame of B against B's reference, where a pair has contact."""
        return self._pictures(shot.image, self._b.reference, region)

    def _pictures(self, one: metrics.Picture, other: metrics.Picture, region: Mask) -> Numbers:
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

    def surfaces(self, a: SurfaceEstimate, b: SurfaceEstimate, drawn: SurfaceEstimate) -> Numbers:
        """Of A's surface against B's, where B or `drawn` is pressed."""
        pressed_a, pressed_b, of_drawn = (metrics.pressed_region(t.height, CONTACT_HEIGHT) for t in (a, b, drawn))
        where = (of_drawn | pressed_b) & b.valid
        deepest = float(b.height.max(initial=0.0))
        error = metrics.height_error(a.height, b.height, where)
        pressed = _contacts(pressed_a, pressed_b)
        return {
            "gradient_angle": metrics.gradient_angle(a.gradient, b.gradient, where),
            "height_rmse": error,
            "height_share": error / deepest if deepest > CONTACT_HEIGHT else math.nan,
            "surface_iou": pressed["contact_iou"],
            "surface_radius": pressed["contact_radius"] * self._grid.pitch,
            "surface_centroid": pressed["contact_centroid"] * self._grid.pitch,
            "marker_error": math.nan
            if a.flow is None or b.flow is None or a.flow.shape != b.flow.shape
            else metrics.end_point_error(a.flow, b.flow),
        }

    def noise(self, still: SurfaceEstimate, on: SurfaceEstimate) -> Numbers:
        """Of the surface found in an untouched frame of B against a flat one, where another is pressed."""
        where = metrics.pressed_region(on.height, CONTACT_HEIGHT) & on.valid
        error = metrics.height_error(still.height, np.zeros_like(still.height), where)
        deepest = float(on.height.max(initial=0.0))
        return {
            "gradient_angle": metrics.gradient_angle(still.gradient, np.zeros_like(still.gradient), where),
            "height_rmse": error,
            "height_share": error / deepest if deepest > CONTACT_HEIGHT else math.nan,
        }

    def swapped(self) -> list[str]:
        """A warning if the pairs agree better with red and blue exchanged."""
        plain, swapped = (float(np.mean(values)) if values else 0.0 for values in (self._plain, self._swapped))
        if swapped > 0.5 and swapped > plain + SWAPPED:
            return [
                f"red and blue look swapped in A or B: exchanged they correlate by {swapped:.2f}, as they are by "
                f"{plain:.2f}; OpenCV's pictures are BGR"
            ]
        return []


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
) -> tuple[Alignment, list[str]]:
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
        return alignment, []
    chosen = couples if len(couples) <= LOOKED_AT else [
        couples[int(k)] for k in np.linspace(0, len(couples) - 1, LOOKED_AT)
    ]  # fmt: skip
    base_a, base_b = alignment(a.reference), b.reference.astype(np.float32)
    changes = ((alignment(one.image) - base_a, other.image - base_b) for one, other in chosen)
    return find_shift(changes, alignment), []


def _floor(
    judge: _Judge, b: FrameSet, pairs: Sequence[Pair], calibration: Calibration | None, grid: CanonicalGrid
) -> tuple[Numbers, list[str]]:
    """What two pictures of B without contact score, where the pairs have contact; and in words if there are none."""
    quiet = [pair.b for pair in pairs if not pair.region.any()]
    frames = [*b.untouched, *quiet][:NOISE_FRAMES]
    touched = [pair for pair in pairs if pair.region.any()]
    if not frames or not touched:
        why = "B has no second frame without contact" if not frames else "no pair has contact"
        return {}, [f"noise floor absent: {why}"]
    scores = [judge.against_reference(frame, pair.region) for frame in frames for pair in touched]
    floor = {key: _mean([score[key] for score in scores]) for key in scores[0]}
    found, _ = estimate_surfaces(b, frames, calibration, grid)
    pressed, _ = estimate_surfaces(b, [pair.b for pair in touched], calibration, grid)
    if found is not None and pressed is not None:
        surfaces = [judge.noise(still, on) for still in found for on in pressed]
        floor |= {key: _mean([score[key] for score in surfaces]) for key in surfaces[0]}
    return floor, [f"noise floor from {len(frames)} more frames of B without contact"]


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


def _few(count: int) -> list[str]:
    if count >= FEWEST:
        return []
    return [f"{count} pair{'s' if count > 1 else ''}: too few for intervals; {FEWEST} are the least"]


def _mean(values: Sequence[float] | Float64) -> float:
    """Mean of what is known; NaN if nothing is. Infinite where one is: the PSNR of equal pictures."""
    array = np.asarray(values, dtype=np.float64)
    known = array[~np.isnan(array)]
    return float(known.mean()) if known.size else math.nan

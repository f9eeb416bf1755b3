"""Numbers for a pair of pictures in the same pixels, and the automatic alignment of A with the pixels of B: one scale
and one shift for the whole comparison.

Pictures are (H, W, 3) on the grey scale 0..255; `where` (H, W) limits a metric to some pixels, such as those in
contact. A metric without data (no pixel, no contact) is NaN.

A sensor does not move in its housing, and a shift for each pair would hide that contacts are in the wrong place.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.compare import tuning
from calibration.errors import BadFrames
from tacsim.interface import Float32, FloatArray, Mask
from tacsim.models.sensor import SensorGeometry

Picture = NDArray[np.uint8] | NDArray[np.floating]

WHITE = 255.0  # grey level
WINDOW = 7  # side of the window of SSIM [px]


@dataclass(frozen=True, slots=True)
class Patch:
    """A contact as a circle of the same area."""

    x: float  # of the centroid; columns, to the right
    y: float  # rows, down
    radius: float


def mean_absolute_error(one: Picture, other: Picture, where: Mask | None = None) -> float:
    """Mean |one - other| over pixels and channels [grey levels]."""
    return _masked_mean(np.abs(_masked_difference(one, other)), where)


def peak_signal_to_noise(one: Picture, other: Picture, where: Mask | None = None) -> float:
    """10 log10(255^2 / mean square error) [dB]; infinite for equal pictures."""
    square = _masked_mean(_masked_difference(one, other) ** 2, where)
    if math.isnan(square):
        return math.nan
    return 10.0 * math.log10(WHITE**2 / square) if square > 0 else math.inf


def similarity_map(one: Picture, other: Picture) -> FloatArray:
    """(H, W) SSIM (Wang et al., IEEE TIP 2004), mean over channels: uniform window of 7 x 7, sample covariance,
    reflecting border. scikit-image's `structural_similarity` gives the same numbers."""
    import cv2

    _require_alike(one, other)
    a, b = np.asarray(one, dtype=np.float64), np.asarray(other, dtype=np.float64)
    if min(a.shape[:2]) < WINDOW:
        raise ValueError(f"pictures of {a.shape[1]} x {a.shape[0]} px are smaller than SSIM's window of {WINDOW} px")

    def mean(picture: FloatArray) -> FloatArray:
        return np.asarray(cv2.blur(picture, (WINDOW, WINDOW), borderType=cv2.BORDER_REFLECT), dtype=np.float64)

    unbiased = WINDOW**2 / (WINDOW**2 - 1.0)
    mean_a, mean_b = mean(a), mean(b)
    variance_a = unbiased * (mean(a * a) - mean_a * mean_a)
    variance_b = unbiased * (mean(b * b) - mean_b * mean_b)
    covariance = unbiased * (mean(a * b) - mean_a * mean_b)
    c1, c2 = (0.01 * WHITE) ** 2, (0.03 * WHITE) ** 2
    above = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    below = (mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2)
    return np.asarray((above / below).reshape(*a.shape[:2], -1).mean(axis=-1))


def structural_similarity(one: Picture, other: Picture, where: Mask | None = None) -> float:
    """Mean of :func:`similarity_map`, over `where` or over all pixels except a border of half a window."""
    similarity = similarity_map(one, other)
    if where is None:
        rim = WINDOW // 2
        return float(similarity[rim:-rim, rim:-rim].mean())
    return _masked_mean(similarity, where)


def image_correlation(one: Picture, other: Picture, where: Mask | None = None) -> float:
    """Pearson's correlation of two changes of colour (normalised cross-correlation without shift), over pixels and
    channels; 0 if either does not vary."""
    _require_alike(one, other)
    a, b = (np.asarray(picture, dtype=np.float64)[... if where is None else where].ravel() for picture in (one, other))
    if a.size == 0:
        return math.nan
    a, b = a - a.mean(), b - b.mean()
    power = math.sqrt(float(a @ a) * float(b @ b))
    return float(a @ b) / power if power > 1e-9 * a.size else 0.0


def grain_deviation(change: Picture, where: Mask) -> float:
    """Standard deviation of the detail finer than GRAIN pixels in a change of colour [grey levels]: noise, and texture
    of the skin."""
    width = 1.0  # what a Gaussian of this deviation takes away is grain [px]
    import cv2

    picture = np.asarray(change, dtype=np.float32)
    return math.sqrt(
        _masked_mean(np.asarray(picture - cv2.GaussianBlur(picture, (0, 0), width), np.float64) ** 2, where)
    )


def mean_normal_angle(one: NDArray[np.floating], other: NDArray[np.floating], where: Mask | None = None) -> float:
    """Mean angle between the surface normals of two fields of slopes (h, w, 2) [degrees]."""
    a, b = (np.asarray(slopes, dtype=np.float64) for slopes in (one, other))
    if a.shape != b.shape or a.ndim != 3 or a.shape[2] != 2:
        raise ValueError(f"slopes must be (h, w, 2) and of equal shape, got {a.shape} and {b.shape}")
    # by the cross product too: the arc cosine alone loses angles below 1e-6
    dot = 1.0 + (a * b).sum(axis=-1)
    cross = np.stack([b[..., 1] - a[..., 1], a[..., 0] - b[..., 0], a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]])
    return _masked_mean(np.degrees(np.arctan2(np.sqrt((cross**2).sum(axis=0)), dot)), where)


def height_error(one: NDArray[np.floating], other: NDArray[np.floating], where: Mask | None = None) -> float:
    """Root mean square difference of two height maps (h, w), in their unit."""
    return math.sqrt(_masked_mean(_masked_difference(one, other) ** 2, where))


def intersection_over_union(one: Mask, other: Mask) -> float:
    """Intersection over union of two masks; NaN if both are empty."""
    _require_alike(one, other)
    union = int((one | other).sum())
    return float((one & other).sum() / union) if union else math.nan


def end_point_error(one: NDArray[np.floating], other: NDArray[np.floating]) -> float:
    """Mean distance of the ends of two displacement fields (m, n, 2) of the same markers, in their unit. A marker that
    either has not found (NaN) is left out."""
    return _masked_mean(np.sqrt((_masked_difference(one, other) ** 2).sum(axis=-1)), None)


def contact_region(change: NDArray[np.floating]) -> Mask:
    """(H, W) where a change of colour (H, W, 3) [grey levels] shows contact.

    A change of the whole picture (drift of the light) is no contact. The region extends to a quarter of the strongest
    change, so it is the same in a bright and in a dim picture; its holes are filled, because the flat centre of a press
    has the colour of the untouched gel.
    """
    gap = 3  # radius of gaps in a contact that are closed [px]
    import cv2
    from scipy.ndimage import binary_closing, binary_fill_holes, label

    smooth = np.asarray(
        cv2.GaussianBlur(np.asarray(change, dtype=np.float32), (0, 0), tuning.CONTACT_BLUR), dtype=np.float32
    )
    red, green, blue = (np.abs(smooth[..., k] - level) for k, level in enumerate(untouched_change(smooth)))
    strength = np.maximum(np.maximum(red, green), blue)
    # the noise is the spread of the half of the pixels that changes least
    noise = 1.4826 * float(np.median(strength[strength <= np.median(strength)]))
    share = tuning.MIN_CHANGE_SHARE * float(np.percentile(strength, 99.8))
    found = strength > max(tuning.MIN_CHANGE, tuning.MIN_CHANGE_TO_NOISE * noise, share)
    padded = np.pad(found, gap)  # closing erodes what touches the border
    closed = binary_closing(padded, iterations=gap)[gap:-gap, gap:-gap]
    parts, _ = label(binary_fill_holes(closed | found))
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return np.asarray(sizes[parts] >= tuning.MIN_PATCH_AREA)


def untouched_change(change: NDArray[np.floating]) -> NDArray[np.floating]:
    """(3,) change of colour of the untouched gel: the median over (H, W, 3), then over the half nearest to it."""
    pixel_count = 10000  # enough for a median
    pixels = change.reshape(-1, change.shape[2])
    pixels = pixels[:: max(1, len(pixels) // pixel_count)]
    level = np.median(pixels, axis=0)
    away = np.abs(pixels - level).max(axis=1)
    return np.asarray(np.median(pixels[away <= np.median(away)], axis=0))


def pressed_region(height: NDArray[np.floating], min_depth: float) -> Mask:
    """(h, w) where a surface is pressed in by more than half of its depth, if that is deeper than `min_depth` (same
    unit). Under a ball on a half-space this is the contact circle (Hertz: half the depth at its rim)."""
    deepest = float(height.max(initial=0.0))
    return np.asarray(height > 0.5 * deepest) if deepest > min_depth else np.zeros(height.shape, dtype=np.bool_)


def circle_of_region(region: Mask) -> Patch | None:
    """The circle of a region (H, W) [px]; None when it is empty."""
    rows, columns = np.nonzero(region)
    if len(rows) == 0:
        return None
    return Patch(float(columns.mean()), float(rows.mean()), math.sqrt(len(rows) / math.pi))


def _require_alike(one: NDArray[np.generic], other: NDArray[np.generic]) -> None:
    if one.shape != other.shape:
        raise ValueError(f"shapes differ: {one.shape} and {other.shape}; align them first")


def _masked_difference(one: NDArray[np.generic], other: NDArray[np.generic]) -> FloatArray:
    _require_alike(one, other)
    return np.asarray(one, dtype=np.float64) - np.asarray(other, dtype=np.float64)


def _masked_mean(values: FloatArray, where: Mask | None) -> float:
    chosen = values if where is None else values[where]
    known = chosen[np.isfinite(chosen)]
    return float(known.mean()) if known.size else math.nan


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Map from the pixels of B to the picture of A. Pixel centres are integers, x right, y down."""

    a_from_b: FloatArray  # (2, 3) affine: x, y in A of x, y in B
    shape: tuple[int, int]  # rows, columns of B
    source: tuple[int, int]  # ... of A
    shift: tuple[float, float] = (0.0, 0.0)  # fitted part: displacement of A's contacts from B's [px of B]
    description: str = "pixel for pixel"

    @property
    def covered_mask(self) -> NDArray[np.bool_]:
        """(rows, columns) pixels of B that A shows."""
        rows, columns = self.shape
        u, v = np.meshgrid(np.arange(columns), np.arange(rows))
        x, y = np.einsum("ij,jkl->ikl", self.a_from_b, np.stack([u, v, np.ones_like(u)]))
        near = 0.5 + 1e-6
        return np.asarray((x >= -near) & (x <= self.source[1] - 1 + near) & (y >= -near)
                          & (y <= self.source[0] - 1 + near))  # fmt: skip

    def __call__(self, picture: NDArray[Any]) -> Float32:
        """(rows, columns, 3) a picture of A, 0..255, at the pixels of B; outside A its border."""
        import cv2

        picture = np.asarray(picture, dtype=np.float32)
        if self.shape == self.source and np.array_equal(self.a_from_b, np.eye(2, 3)):
            return picture
        scale = float(np.sqrt(abs(np.linalg.det(self.a_from_b[:, :2]))))
        if scale > 1.0:  # else fine detail of A would alias
            picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.5 * np.sqrt(scale**2 - 1) + 1e-3))
        # cubic: between two pixels a linear one would average the camera's noise away, and look better than it is
        seen = cv2.warpAffine(
            picture,
            self.a_from_b,
            (self.shape[1], self.shape[0]),
            flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        clipped: Float32 = np.clip(np.asarray(seen, dtype=np.float32), 0.0, 255.0)  # it overshoots at edges
        return clipped

    def shifted(self, shift: tuple[float, float], description: str) -> Alignment:
        """The alignment with A's pictures moved by `shift` [px of B]."""
        moved = np.eye(3)
        moved[:2, 2] = shift
        whole = np.vstack([self.a_from_b, [0.0, 0.0, 1.0]]) @ moved
        return Alignment(whole[:2], self.shape, self.source, shift, f"{self.description}; {description}")


def align_by_size(source: tuple[int, int], shape: tuple[int, int]) -> Alignment:
    """A of `source` rows, columns scaled to B's `shape`: both show the same part of the gel.
    Raises BadFrames when their proportions differ."""
    if source == shape:
        return Alignment(np.eye(2, 3), shape, source)
    across, down = source[1] / shape[1], source[0] / shape[0]
    if abs(across / down - 1) > tuning.MAX_ASPECT_ERROR:
        raise BadFrames(
            f"A is {source[1]} x {source[0]} px, B {shape[1]} x {shape[0]}: no scale makes these the same picture. "
            "Give the sensors' calibrations (--calibration-a, --calibration-b) or the corners of the gel (--corners-a, "
            "--corners-b)"
        )
    # pixel centres are whole numbers, so a picture begins at -1/2
    matrix = np.array([[across, 0.0, (across - 1) / 2], [0.0, down, (down - 1) / 2]])
    return Alignment(matrix, shape, source, description=f"A scaled by {1 / across:.3g} to the size of B")


def align_by_geometry(source: SensorGeometry, target: SensorGeometry) -> Alignment:
    """Both pictures on the gel, in metres, by their calibrated geometries."""
    scale = target.pixel_pitch / source.pixel_pitch
    offset = np.array(source.principal) - scale * np.array(target.principal)
    matrix = np.array([[scale, 0.0, offset[0]], [0.0, scale, offset[1]]])
    said = "by the calibrated geometries" if source != target else "pixel for pixel, of one geometry"
    return Alignment(matrix, (target.height, target.width), (source.height, source.width), description=said)


def find_shift(changes: Iterable[tuple[Float32, Float32]], alignment: Alignment) -> Alignment:
    """`alignment` with the shift that brings the contacts of A onto those of B.

    `changes`: of each pair the changes of colour (rows, columns, 3) of A (in the pixels of B) and of B. For each pair
    with contact in both, the shift is found to a fraction of a pixel from the strength of the change, independent of
    its colours (enhanced correlation coefficient, Evangelidis and Psarakis 2008). The result is the median of all.
    """
    found = [shift for pair in changes if (shift := _find_image_shift(*pair)) is not None]
    if not found:
        return alignment.shifted((0.0, 0.0), "no pair shows contact on both sides, so no shift was estimated")
    shifts = np.array(found)
    middle = np.median(shifts, axis=0)
    scatter = float(np.median(np.linalg.norm(shifts - middle, axis=1)))
    size = max(alignment.shape)
    words = f"({middle[0]:+.2f}, {middle[1]:+.2f}) px"
    if scatter > tuning.MAX_SHIFT_SCATTER * size:
        return alignment.shifted((0.0, 0.0), f"not shifted: the pairs disagree by {scatter:.0f} px; are they pairs?")
    if float(np.linalg.norm(middle)) > tuning.MAX_SHIFT * size:
        return alignment.shifted((0.0, 0.0), f"not shifted: {words} is too far; are these pairs?")
    x, y = (float(value) for value in middle)
    return alignment.shifted((x, y), f"shifted by {words}, the pairs agree within {scatter:.2f} px")


def _find_image_shift(a: Float32, b: Float32) -> tuple[float, float] | None:
    """x, y from a point of `b` to the same in `a` [px]; None without contact, or if no shift is found."""
    tolerance = 1e-4
    max_steps = 200
    window = 5  # side of the Gaussian window of the fit [px]
    import cv2

    patches = [circle_of_region(contact_region(change)) for change in (a, b)]
    if patches[0] is None or patches[1] is None:
        return None
    template, moved = _change_strength(b), _change_strength(a)
    start = np.eye(2, 3, dtype=np.float32)
    start[:, 2] = patches[0].x - patches[1].x, patches[0].y - patches[1].y
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, max_steps, tolerance)
    mask = np.ones(moved.shape, dtype=np.uint8)
    try:
        _, warp = cv2.findTransformECC(template, moved, start, cv2.MOTION_TRANSLATION, criteria, mask, window)
    except cv2.error:  # no convergence: these pictures do not show the same
        return None
    return float(warp[0, 2]), float(warp[1, 2])


def _change_strength(change: Float32) -> Float32:
    away = change - untouched_change(change)
    strength: Float32 = np.sqrt(np.einsum("ijk,ijk->ij", away, away)).astype(np.float32)
    return strength

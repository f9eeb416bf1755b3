"""Noise of a real camera: the difference between two pictures without contact, or outside the contact of a press; and
the share of the untouched picture's grain that is on the gel's skin."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from calibration.light.press import BallPress, mean_reference_colour
from calibration.light.tuning import UNTOUCHED_RADIUS
from calibration.reference import DriftFinder
from calibration.tuning import SATURATED_LEVEL
from tacsim.interface import FloatArray, Image
from tacsim.models.sensor import CameraNoise
from tacsim.optics.ink import high_pass

Entry = TypeVar("Entry", bound=np.generic)

TILE = 32  # side of the tiles; what is wider is drift, not noise [px]
MAX_DARK_LEVEL = 2  # a channel at or below this has lost its noise [grey levels]
SKIN_NEAR = (1.25, 2.2)  # region in which the skin has moved, and the light changes little [contact radii]
SKIN_FAR = (4.0, 8.0)  # region in which it has hardly moved, in a similar light
# A smaller one cannot be distinguished from none: three real sensors without skin have at most 0.07.
MIN_SKIN_SHARE = 0.2
MIN_STANDARD_ERRORS = 3.0  # standard errors over presses that the share must be from none


class NoiseUnknown(ValueError):
    """Noise cannot be measured in these pictures. The message gives the reason, and what to do."""


def measure_noise(frames: Sequence[Image]) -> CameraNoise:
    """From two or more pictures (H, W, 3) uint8 RGB without contact, of one camera and setting, in the order taken.

    Two pictures far apart in time are subtracted, which removes constant structure; then a quadratic in the place, the
    drift of the light, and the mean of each tile are subtracted. Spread and correlations are those of the median tile,
    so changes on less than half of the picture (a touch, a reflection) have no effect. The median absolute deviation of
    pixels is not used: for integer grey levels it has steps as large as the noise of a good camera.

    Tiles reduce the spread of correlated noise slightly: by 1.6 % if neighbours are correlated by 0.7.
    Raises NoiseUnknown.
    """
    if len(frames) < 2:
        raise NoiseUnknown(f"noise is what differs between pictures without contact; there is {len(frames) or 'none'}")
    if len({frame.shape for frame in frames}) > 1:
        raise NoiseUnknown("the pictures without contact differ in size")
    apart = len(frames) // 2
    pairs = [pair for pair in zip(frames, frames[apart:], strict=False) if not np.array_equal(*pair)]
    if not pairs:
        raise NoiseUnknown("the pictures without contact are all the same one; take them from the running camera")
    return _noise_of_tiles(np.concatenate([_difference_tiles(*pair) for pair in pairs]))


def measure_press_noise(presses: Sequence[BallPress], reference: Image) -> CameraNoise:
    """The same from presses and one `reference` (H, W, 3) without contact, outside the contacts: farther than FAR
    contact radii from the centre. Both are assumed to have equal noise; small changes between them, such as dirt,
    count as noise. Raises NoiseUnknown."""
    mean = mean_reference_colour(reference)
    dark = (reference <= MAX_DARK_LEVEL).any(axis=2)
    cut = []
    for press in presses:
        touched = press.distance() < UNTOUCHED_RADIUS * press.circle.radius
        cut.append(_valid_tiles(press.change * mean, touched | dark | ~press.lit.all(axis=2)))
    return _noise_of_tiles(np.concatenate(cut))


def _noise_of_tiles(tiles: FloatArray) -> CameraNoise:
    """Noise from tiles (n, h, w, 3) of differences of two pictures. Raises NoiseUnknown."""
    min_tiles = 4
    if len(tiles) < min_tiles:
        raise NoiseUnknown(
            f"only {len(tiles)} parts of {TILE} x {TILE} px are untouched and neither black nor saturated in all "
            f"pictures; {min_tiles} are needed"
        )
    size = tiles.shape[1] * tiles.shape[2]
    square = np.einsum("nyxc,nyxd->ncd", tiles, tiles) / (2 * (size - 1))  # 2: both pictures are noisy
    along_x = np.einsum("nyxc,nyxc->n", tiles[:, :, 1:], tiles[:, :, :-1])
    along_y = np.einsum("nyxc,nyxc->n", tiles[:, 1:], tiles[:, :-1])
    pixels = np.einsum("nyxc,nyxc->n", tiles, tiles)
    covariance = np.median(square, axis=0)
    deviation = np.sqrt(np.diag(covariance))
    if not (deviation > 0).any():
        raise NoiseUnknown("the pictures do not differ on most of the untouched gel")
    # a row of a tile has one pair less than pixels
    ends = tiles.shape[2] / (tiles.shape[2] - 1), tiles.shape[1] / (tiles.shape[1] - 1)
    usual = float(np.median(pixels))
    beside = [end * float(np.median(products)) / usual for end, products in zip(ends, (along_x, along_y), strict=True)]
    red_green, red_blue, green_blue = _nearest_correlations(covariance, deviation)
    return CameraNoise(
        deviation=(float(deviation[0]), float(deviation[1]), float(deviation[2])),
        colours=(red_green, red_blue, green_blue),
        neighbours=(beside[0], beside[1]),
    )


def _difference_tiles(one: Image, other: Image) -> FloatArray:
    """(n, h, w, 3) the difference of two pictures by tiles, without drift and mean, where neither is black or
    saturated."""
    most, least = np.maximum(one, other).max(axis=2), np.minimum(one, other).min(axis=2)
    lost = np.asarray((most >= SATURATED_LEVEL) | (least <= MAX_DARK_LEVEL))
    level = np.maximum(one.mean(axis=(0, 1)), 1.0)
    change = other.astype(np.float32) - one
    planes = np.ascontiguousarray(np.moveaxis(change / level.astype(np.float32), -1, 0), dtype=np.float32)
    find = DriftFinder((one.shape[0], one.shape[1]))
    find.remove(planes, find(planes, lost))
    return _valid_tiles(np.asarray(np.moveaxis(planes, 0, -1) * level, dtype=np.float64), lost)


def _valid_tiles(difference: FloatArray, lost: NDArray[np.bool_]) -> FloatArray:
    """(n, h, w, 3) tiles of a difference (H, W, 3) that hold no `lost` pixel (H, W), each less its mean."""
    size = min(TILE, *difference.shape[:2])
    tiles = _cut_tiles(difference, size)[~_cut_tiles(lost[..., None], size).any(axis=(1, 2, 3))]
    return np.asarray(tiles - tiles.mean(axis=(1, 2), keepdims=True), dtype=np.float64)


def _cut_tiles(picture: NDArray[Entry], size: int) -> NDArray[Entry]:
    """(n, size, size, channels) of (H, W, channels); what is left over at the right and lower border is dropped."""
    rows, columns, channels = picture.shape[0] // size, picture.shape[1] // size, picture.shape[2]
    whole = picture[: rows * size, : columns * size].reshape(rows, size, columns, size, channels)
    return whole.swapaxes(1, 2).reshape(-1, size, size, channels)


def _nearest_correlations(covariance: FloatArray, deviation: FloatArray) -> tuple[float, float, float]:
    """Correlations R-G, R-B, G-B, of the valid correlation matrix nearest to the medians of the tiles."""
    scale = np.where(deviation > 0, deviation, 1.0)
    correlation = covariance / np.outer(scale, scale)
    np.fill_diagonal(correlation, 1.0)
    values, vectors = np.linalg.eigh(correlation)
    whole = (vectors * np.maximum(values, 0.0)) @ vectors.T
    whole /= np.sqrt(np.outer(np.diag(whole), np.diag(whole)))
    return float(whole[0, 1]), float(whole[0, 2]), float(whole[1, 2])


def measure_skin(presses: Sequence[BallPress], reference: NDArray[np.uint8], pixel_pitch: float) -> float | None:
    """Share of the fine part of `reference` (H, W, 3) that moves with the gel, 0 to 1; None if the presses do not show
    any. pixel_pitch: [m].

    Fixed grain, of the camera or of dust on its lens, is the same everywhere in a press. Grain of the skin is the same
    far from the contact, but not near it, because there the gel has moved by a few pixels.

    The estimate is a lower bound: skin that has moved by less than its grain counts as fixed.
    """
    min_presses = 4
    min_pixels = 1000  # of either part of a press
    mean = reference.mean(axis=(0, 1))
    grain = high_pass(reference.astype(np.float32), pixel_pitch)
    shares = []
    for press in presses:
        change = high_pass((press.change * mean).astype(np.float32), pixel_pitch)
        lit, distance = press.lit.all(axis=2), press.distance() / press.circle.radius
        parts = [lit & (distance > least) & (distance < most) for least, most in (SKIN_FAR, SKIN_NEAR)]
        if min(int(part.sum()) for part in parts) >= min_pixels:
            far, near = (1.0 + float((change[part] * grain[part]).sum() / (grain[part] ** 2).sum()) for part in parts)
            shares.append(far - max(near, 0.0))
    if len(shares) < min_presses:
        return None
    share, error = float(np.median(shares)), float(np.std(shares, ddof=1)) / len(shares) ** 0.5
    return min(share, 1.0) if share > max(MIN_SKIN_SHARE, MIN_STANDARD_ERRORS * error) else None

"""Detection of dark dots in a picture, with centres to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.markers.tuning import DARKNESS_LEVELS
from tacsim.interface import Float32, FloatArray, Image
from tacsim.optics.ink import DotEraser as DotEraser
from tacsim.optics.ink import dot_filters, local_darkness


@dataclass(frozen=True, slots=True, eq=False)
class Dots:
    """The dots of one picture."""

    centres: FloatArray  # (n, 2) u, v [px]
    areas: FloatArray  # (n,) [px^2]

    @property
    def radius(self) -> float:
        """Radius of a disc with the median area [px]."""
        return float(np.sqrt(np.median(self.areas) / np.pi)) if len(self.areas) else 0.0


class DotFinder:
    """Finds dots of about one radius [px].

    Darkness is the difference of a picture from its closing (the brightness around each place), as a share of the
    closing. Unlike a difference of Gaussians it finds no dot on the dark side of a step of brightness, which every rim
    of a contact has. A centre is the mean of the dot's pixels, weighted with their darkness above the threshold.
    """

    def __init__(self, radius: float) -> None:
        """Raises ValueError for dots too small to be found."""
        self._side, self._blur = dot_filters(radius)
        self._area = np.pi * radius**2

    def __call__(self, image: Image) -> Dots:
        """The dots of a picture (H, W, 3) or of one channel of it (H, W)."""
        dark = local_darkness(image, self._side, self._blur)
        found = []
        for level in DARKNESS_LEVELS:
            dots, rest = self._find_blobs(dark, level)
            found.append(dots)
            if rest is None:
                break
            dark = rest
        return Dots(np.concatenate([d.centres for d in found]), np.concatenate([d.areas for d in found]))

    def _find_blobs(self, dark: Float32, level: float) -> tuple[Dots, Float32 | None]:
        """The dots among the blobs above `level`, and the rest in blobs that are too large or long to be one."""
        max_elongation = 2.0  # length over breadth
        min_area, max_area = 0.2, 7.0  # of a dot, half hidden or painted over [areas of a disc]
        min_filled = 0.4  # share of its bounding box that a dot fills
        import cv2

        mask = (dark > level).astype(np.uint8)
        kind = cv2.CV_16U if mask.size < 1 << 16 else cv2.CV_32S  # room for as many labels as pixels; 16 is faster
        count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4, ltype=kind)
        area = stats[:, cv2.CC_STAT_AREA]
        width, height = stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]
        large = area > min_area * self._area
        compact = (area < max_area * self._area) & (
            np.maximum(width, height) < max_elongation * np.minimum(width, height)
        )
        compact &= area > min_filled * width * height
        large[0] = False  # what is no blob
        good = large & compact
        where = np.flatnonzero(mask)
        label = labels.ravel()[where].astype(np.intp)
        weight = dark.ravel()[where].astype(np.float64) - level
        rows, columns = np.divmod(where, mask.shape[1])
        total = np.maximum(np.bincount(label, weight, count), 1e-12)
        centres = np.stack([np.bincount(label, weight * at, count) / total for at in (columns, rows)], axis=1)
        dots = Dots(centres[good], area[good].astype(np.float64))
        clumps = large & ~compact
        return dots, np.where(clumps[labels], dark, np.float32(0.0)) if clumps.any() else None

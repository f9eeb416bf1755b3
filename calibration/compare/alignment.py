"""Automatic alignment of A with the pixels of B: one scale and one shift for the whole comparison.

A sensor does not move in its housing, and a shift for each pair would hide that contacts are in the wrong place.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.compare.metrics import circle_of_region, contact_region, untouched_change
from calibration.compare.tuning import MAX_ASPECT_ERROR, MAX_SHIFT, MAX_SHIFT_SCATTER
from calibration.errors import BadFrames
from tacsim.interface import Float32, FloatArray
from tacsim.models.sensor import SensorGeometry


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
    if abs(across / down - 1) > MAX_ASPECT_ERROR:
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
    if scatter > MAX_SHIFT_SCATTER * size:
        return alignment.shifted((0.0, 0.0), f"not shifted: the pairs disagree by {scatter:.0f} px; are they pairs?")
    if float(np.linalg.norm(middle)) > MAX_SHIFT * size:
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

"""Roughness that the sampling of a body prints on a gel: the height without its local form.

Definition. Form: the least-squares quadratic of the height in the window of 5 x 5 surface nodes around a node (Savitzky
and Golay, Anal. Chem. 36, 1627, 1964, in two dimensions); it contains all slopes, curvature and cubic terms.
Residual: height minus form at the centre, divided by the residual's gain for white noise, so that independent noise of
deviation s at the nodes gives s. Roughness: its root mean square (Sq of ISO 25178-2) over the inside of the contact,
those nodes whose window lies in the print. Real form counts only by its fourth order; choose a print much wider than
five nodes, else its rim is in every window.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tacsim.models.scene import GelSurface

if TYPE_CHECKING:
    from tacsim.interface import FloatArray

HALF = 2  # nodes from the centre of the window to its edge
SHARE = 0.5  # the print is deeper than this share of its typical depth


def filter_weights() -> FloatArray:
    """Weights (5, 5) of the residual in a window; their squares add to 1, and any cubic polynomial gives 0."""
    steps = np.arange(-HALF, HALF + 1.0)
    x, y = (a.ravel() for a in np.meshgrid(steps, steps, indexing="ij"))
    form = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    weights = -(form @ np.linalg.pinv(form))[len(x) // 2]
    weights[len(x) // 2] += 1.0
    normed: FloatArray = (weights / np.linalg.norm(weights)).reshape(len(steps), len(steps))
    return normed


def inside_print(depth: FloatArray) -> np.ndarray:
    """Nodes (nx, ny), bool, whose 5 x 5 window is inside the print; holes in it are filled."""
    from scipy.ndimage import binary_closing, binary_erosion, binary_fill_holes

    touched = depth > 0.2 * depth.max()
    typical = np.percentile(depth[touched], 75)
    square = np.ones((3, 3), dtype=bool)
    # closing must not meet the border of the array
    closed = binary_closing(np.pad(depth > SHARE * typical, 3), square)
    filled = binary_fill_holes(closed)[3:-3, 3:-3]
    return np.asarray(binary_erosion(filled, square, iterations=HALF))


def print_roughness(surface: GelSurface) -> float:
    """Roughness [m] of the print on a gel's surface, as this module defines it.

    Raises ValueError without a print, or if no window fits into it: press deeper, or use a finer gel.
    """
    from scipy.ndimage import correlate

    depth = -surface.displacement[..., 2].astype(np.float64)
    inside = inside_print(depth) if depth.max() > 0 else np.zeros(depth.shape, dtype=bool)
    if not inside.any():
        raise ValueError(
            f"no print of at least {2 * HALF + 1} x {2 * HALF + 1} surface nodes ({surface.spacing * 1e3:g} mm apart) "
            f"to measure roughness in; press deeper, or choose a smaller element_size"
        )
    residual = correlate(depth, filter_weights(), mode="nearest")[inside]
    return float(np.sqrt(np.mean(residual**2)))

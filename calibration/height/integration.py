"""Slopes -> height by Poisson's equation, zero at the untouched rim of the view; and the slopes of that height."""

from __future__ import annotations

import numpy as np

from calibration.height.tuning import RIM_WIDTH
from tacsim.interface import Float32


class Integrator:
    """Integrates slopes on a rectangle of pixels: the surface whose slopes are nearest to those given, in the sense of
    least squares, with a free border (cosine transform; Frankot and Chellappa 1988, Poisson with natural boundary)."""

    def __init__(self, shape: tuple[int, int], pitch: float) -> None:
        """`shape`: rows, columns; `pitch`: distance of two pixels [m]."""
        rows, columns = shape
        if min(shape) < 2 or not pitch > 0:
            raise ValueError(f"cannot integrate over {rows} x {columns} pixels of {pitch} m; at least 2 x 2")
        along_y = 2.0 * np.cos(np.pi * np.arange(rows) / rows) - 2.0
        along_x = 2.0 * np.cos(np.pi * np.arange(columns) / columns) - 2.0
        eigenvalue = along_y[:, None] + along_x[None, :]
        eigenvalue[0, 0] = 1.0
        inverse = pitch / eigenvalue
        inverse[0, 0] = 0.0  # slopes determine no constant
        self._inverse = inverse.astype(np.float32)
        width = max(1, round(RIM_WIDTH / pitch))
        rim = np.ones(shape, dtype=np.bool_)
        rim[width:-width, width:-width] = False
        self._rim = np.flatnonzero(rim)

    def __call__(self, gradient: Float32) -> Float32:
        """(rows, columns) height [m] of slopes (rows, columns, 2) along x, y [-].

        The constant is chosen so that the median along the border of the view is zero: one bulge, or a contact that
        reaches the border on one side, does not move it.
        """
        from scipy.fft import dctn, idctn

        by_x, by_y = np.ascontiguousarray(gradient[..., 0]), np.ascontiguousarray(gradient[..., 1])
        across = 0.5 * (by_x[:, 1:] + by_x[:, :-1])  # slopes half-way between two pixels
        down = 0.5 * (by_y[1:] + by_y[:-1])
        divergence = np.zeros(self._inverse.shape, dtype=np.float32)
        divergence[:, :-1] += across
        divergence[:, 1:] -= across
        divergence[:-1] += down
        divergence[1:] -= down
        spectrum = dctn(divergence, norm="ortho", overwrite_x=True)
        spectrum *= self._inverse
        height: Float32 = idctn(spectrum, norm="ortho", overwrite_x=True)
        height -= np.median(height.ravel()[self._rim])
        return height


def slopes_of(height: Float32, pitch: float) -> tuple[Float32, Float32]:
    """Slopes by x and by y (rows, columns) of a height (rows, columns) [m] on pixels `pitch` [m] apart.

    For a height from :class:`Integrator` they are the part of its slopes that a surface can have, without rotational
    errors (half the power of random errors).
    """
    by_y, by_x = np.gradient(height, np.float32(pitch))
    return np.asarray(by_x, dtype=np.float32), np.asarray(by_y, dtype=np.float32)

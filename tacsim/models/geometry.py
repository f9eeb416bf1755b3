"""Where the pixels of a sensor's picture lie on its gel: in a metric picture, and in a camera's through its lens."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from tacsim.interface import FloatArray
from tacsim.models.quantity import Config, Length

PixelCount = Annotated[int, Field(ge=16, le=8192)]
Positive = Annotated[Length, Field(gt=0)]
Pair = tuple[float, float]
# Corners u, v [px] of the polygon of a camera's picture that shows gel, one after the other
PictureRegion = Annotated[tuple[Pair, ...], Field(min_length=3, max_length=64)]


class SensorGeometry(Config):
    """Where the pixels of the (rectified) image lie on the gel: ``x = (u - u0) * pixel_pitch``, likewise y.

    Pixel centres are integers; (u0, v0) defaults to the image centre, so the sensor axis is in the middle.

    A `camera_distance` H makes the camera a pinhole on the sensor axis, that far behind the untouched gel: a dot on a
    surface pressed in by h appears at ``x H / (H - h)``. Without one it looks along parallel rays, x stays x. Only
    dots are drawn so; the colour of the gel is always that of parallel rays.
    """

    width: Annotated[int, Field(ge=16, le=4096)] = 320
    height: Annotated[int, Field(ge=16, le=4096)] = 240
    pixel_pitch: Annotated[Length, Field(ge=1e-6, le=1e-2)] = 0.0625e-3  # [m]
    centre: tuple[float, float] | None = None  # (u0, v0) [px]
    camera_distance: Annotated[Length, Field(ge=2e-3, le=10.0)] | None = None  # [m]; None: parallel rays

    @property
    def principal(self) -> tuple[float, float]:
        """(u0, v0): the pixel on the sensor axis."""
        return ((self.width - 1) / 2.0, (self.height - 1) / 2.0) if self.centre is None else self.centre


class Lens(Config):
    """A pinhole with distortion (Brown's model, as OpenCV has it)."""

    width: PixelCount  # of the picture [px]
    height: PixelCount
    focal: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]]  # fx, fy [px]
    centre: Pair  # cx, cy [px]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)  # k1, k2, p1, p2, k3
    residual: Annotated[float, Field(ge=0)] = 0.0  # root mean square of the calibration [px]

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) [px]"""
        return np.array([[self.focal[0], 0, self.centre[0]], [0, self.focal[1], self.centre[1]], [0, 0, 1.0]])

    def project(self, directions: FloatArray) -> FloatArray:
        """(n, 2) pixels of lines of sight (n, 2), each as x/z, y/z."""
        projection_chunk = 1 << 16  # points at a time: OpenCV makes the Jacobian along, 240 bytes a point
        import cv2

        found = np.empty((len(directions), 2))
        for start in range(0, len(directions), projection_chunk):
            part = slice(start, start + projection_chunk)
            ahead = np.concatenate([directions[part], np.ones((len(directions[part]), 1))], axis=1)
            pixels, _ = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), self.matrix, np.array(self.distortion))
            found[part] = pixels.reshape(-1, 2)
        return found

    def directions(self, pixels: FloatArray) -> FloatArray:
        """(n, 2) lines of sight x/z, y/z of pixels (n, 2)."""
        import cv2

        there = cv2.undistortPointsIter(
            np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2), self.matrix, np.array(self.distortion),
            np.eye(3), np.eye(3), (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12),
        )  # fmt: skip
        return np.asarray(there, dtype=np.float64).reshape(-1, 2)


class GelView(Config):
    """Where the gel lies in the native picture. The sensor's x runs along image columns, where its axis is.

    A point (x, y) of the gel [m] is seen along (a, b, c) = perspective (x, y, 1), at the pixel that `lens` gives a / c,
    b / c.
    """

    lens: Lens
    perspective: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    size: tuple[Positive, Positive]  # x, y of the gel that counts, round the sensor's axis [m]
    pixel_pitch: Positive  # of the rectified picture [m]
    residual: Annotated[float, Field(ge=0)] = 0.0  # root mean square of the points [px]
    residual_length: Annotated[Length, Field(ge=0)] = 0.0  # the same on the gel [m]
    board: str = ""  # by what it was found

    @property
    def image_shape(self) -> tuple[int, int]:
        """Rows, columns of the native picture."""
        return (self.lens.height, self.lens.width)

    @property
    def geometry(self) -> SensorGeometry:
        """Of the rectified picture."""
        width, height = (round(length / self.pixel_pitch) for length in self.size)
        return SensorGeometry(width=width, height=height, pixel_pitch=self.pixel_pitch)

    def project(self, points: FloatArray) -> FloatArray:
        """(..., 2) pixels of points (..., 2) of the gel [m]."""
        seen = ray_slopes(np.array(self.perspective), points.reshape(-1, 2))
        return self.lens.project(seen).reshape(points.shape)

    def on_gel(self, pixels: FloatArray) -> FloatArray:
        """(..., 2) points of the gel's plane [m] at pixels (..., 2): the inverse of :meth:`project`."""
        back = np.linalg.inv(np.array(self.perspective))
        return ray_slopes(back, self.lens.directions(pixels.reshape(-1, 2))).reshape(pixels.shape)


def ray_slopes(perspective: FloatArray, points: FloatArray) -> FloatArray:
    """(n, 2) x / z, y / z of perspective (x, y, 1), for points (n, 2)."""
    lines = points @ perspective[:, :2].T + perspective[:, 2]
    seen: FloatArray = lines[:, :2] / lines[:, 2:]
    return seen

"""Noise of a sensor's camera: what changes between pictures of a scene at rest.

The noise of real cameras is not white: demosaicing, scaling and codecs spread it over neighbouring pixels and, through
the brightness, over all colours. The model is a normal distribution: a deviation for each colour, correlations of the
colours, and from pixel to pixel along a row or a column a correlation that falls as a power of the distance (a Markov
process). It is the same at every brightness: in four recordings of three real sensors the line of EMVA 1288, variance =
a + b * brightness, explained less than a twentieth of how the variance varies over the picture, or fell.
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Float32, Image
from tacsim.models.sensor import CameraNoise, SensorModel

NOISE_FIELDS = 4  # of noise, drawn once for a sensor
FIELD_SHIFTS = 64  # of a field, in rows and in columns


class NoiseSource:
    """Adds a camera's noise to the pictures of one sensor.

    Drawing new noise for each frame would cost more than rendering it. Therefore NOISE_FIELDS fields somewhat larger
    than the image are drawn once, and each frame takes one of them, shifted by up to FIELD_SHIFTS pixels in rows and
    columns. That makes NOISE_FIELDS * FIELD_SHIFTS^2 patterns; seed, sensor, episode and frame alone decide which one.
    Single frames and pairs have the noise of the model; a mean over hundreds of frames keeps more of it than it should.

    Rounding is part of the noise, so that the fields are of whole grey levels. Below a deviation of about one that
    makes them a little less correlated than the model says.
    """

    def __init__(self, noise: CameraNoise, shape: tuple[int, int], sensor: str = "") -> None:
        """`shape`: rows, columns of the image; `sensor`: its name, so that two of one model differ."""
        self._shape = shape
        self._key = (noise.seed, zlib.crc32(sensor.encode()))
        rng = np.random.default_rng(self._key)
        size = (shape[0] + FIELD_SHIFTS - 1, shape[1] + FIELD_SHIFTS - 1)
        self._fields = [_draw_field(noise, size, rng) for _ in range(NOISE_FIELDS)]

    def __call__(self, image: Image, frame: int, episode: int = 0) -> Image:
        """The picture (H, W, 3) as the camera delivers it; black and white are its limits. `frame`, `episode`: numbers
        from 0. Raises ValueError for a picture of another size."""
        import cv2

        if image.shape != (*self._shape, 3):
            raise ValueError(f"image is {image.shape}, the noise is for {(*self._shape, 3)}")
        which, down, right = np.random.default_rng((*self._key, episode, frame)).integers(
            (NOISE_FIELDS, FIELD_SHIFTS, FIELD_SHIFTS)
        )
        rows, columns = self._shape
        drawn = self._fields[which][down : down + rows, right : right + columns]
        return np.asarray(cv2.add(image, drawn, dtype=cv2.CV_8U), dtype=np.uint8)


def noise_source(model: SensorModel, sensor: str) -> NoiseSource | None:
    """Of the sensor of this name; None for a camera without noise."""
    return None if model.noise is None else NoiseSource(model.noise, model.image_shape, sensor)


def _draw_field(noise: CameraNoise, size: tuple[int, int], rng: np.random.Generator) -> NDArray[np.int8]:
    """(rows, columns, 3) noise in whole grey levels."""
    field = rng.standard_normal((*size, 3), dtype=np.float32)
    along_x, along_y = noise.neighbours
    _correlate_rows(field, along_y)
    _correlate_rows(field.transpose(1, 0, 2), along_x)
    values, vectors = np.linalg.eigh(noise.colour_matrix())
    field @= (vectors * np.sqrt(np.maximum(values, 0.0))).T.astype(np.float32)
    whole = np.zeros(field.shape, dtype=np.int8)
    for channel, deviation in enumerate(noise.deviation):
        if deviation > 0:
            whole[..., channel] = _scale_and_round(field[..., channel], deviation)
    return whole


def _correlate_rows(field: Float32, correlation: float) -> None:
    """Correlates each row of independent normal numbers with the one before; their spread stays 1."""
    fresh = np.float32(np.sqrt(1.0 - correlation**2))
    for row in range(1, len(field)):
        field[row] = np.float32(correlation) * field[row - 1] + fresh * field[row]


def _scale_and_round(field: Float32, deviation: float) -> Float32:
    """The normal numbers, scaled so that `deviation` is their standard deviation after rounding."""
    halvings = 20  # of the interval in which a field's scale is sought
    low, high = 0.0, deviation + 1.0
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.rint(np.float32(middle) * field).std() < deviation else (low, middle)
    return np.asarray(np.clip(np.rint(np.float32(high) * field), -127, 127), dtype=np.float32)

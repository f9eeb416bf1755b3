"""The gel's skin in a picture of the untouched gel: grain, print and dust, which move with it; light stays.

What is finer than FINE is either on the skin, or the camera's own pattern and the noise of that one picture. Only a
share of it is on the skin (`SensorModel.skin`); calibration.light.skin measures it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]

BLUR_DEVIATION = 0.25e-3  # standard deviation of the blur that leaves light alone [m]
MIN_LIGHT = 1.0  # least light that skin is told from [grey levels]


def high_pass(picture: Float32, pixel_pitch: float) -> Float32:
    """(H, W, 3) what of a picture is finer than light; `pixel_pitch` [m]."""
    import cv2

    slow = cv2.GaussianBlur(picture, (0, 0), BLUR_DEVIATION / pixel_pitch, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(picture - slow, dtype=np.float32)


def separate_skin(picture: Float32, share: float, pixel_pitch: float) -> tuple[Float32, Float32]:
    """The picture (H, W, 3) of an untouched gel without its skin, which is `share` of its fine part, and (H, W, 3) the
    share of light that the skin lets through, about 1: the product is the picture."""
    bare = picture - np.float32(share) * high_pass(picture, pixel_pitch)
    clean = np.maximum(bare, np.float32(MIN_LIGHT)).astype(np.float32)
    return clean, (picture / clean).astype(np.float32)

"""What lies on the gel and moves with it: dark dots, painted over or lifted off a picture, and the skin.

Skin is grain, print and dust in the picture of the untouched gel. What is finer than GRAIN_BLUR is either on the skin,
or the camera's own pattern and the noise of that one picture. Only a share of it is on the skin (`SensorModel.skin`),
which calibration.light.noise measures.
"""

from __future__ import annotations

import numpy as np

from tacsim.interface import Float32, Image
from tacsim.optics.tuning import DOT_BLUR, MAX_DOT_RADIUS, MIN_EDGE_DARKNESS, MIN_RADIUS

GRAIN_BLUR = 0.25e-3  # standard deviation of the blur that leaves light alone [m]


def dot_filters(radius: float) -> tuple[int, float]:
    """Side of the closing and deviation of the blur for dots of a radius [px]. Raises ValueError."""
    if not radius >= MIN_RADIUS:
        raise ValueError(f"dots of radius {radius:.2g} px cannot be found, at least {MIN_RADIUS:g} px are needed")
    return 2 * int(np.ceil(MAX_DOT_RADIUS * radius)) + 1, DOT_BLUR * radius


def local_darkness(image: Image, side: int, blur: float) -> Float32:
    """(H, W) share of the light that is missing against the frame of `side` x `side` px round each place."""
    import cv2

    if image.ndim == 3:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    calm = np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), blur), dtype=np.float32)
    levels = cv2.convertScaleAbs(calm)  # many times faster to close than float, and fine enough for what is smooth
    bright = cv2.morphologyEx(levels, cv2.MORPH_CLOSE, np.ones((side, side), dtype=np.uint8))
    share = calm / np.maximum(bright, 1).astype(np.float32)
    return np.asarray(np.float32(1.0) - share, dtype=np.float32)


class DotEraser:
    """Paints dots of about one radius [px] over with what surrounds them (Telea 2004): light is calibrated without
    them, since under a press they move."""

    def __init__(self, radius: float) -> None:
        """Raises ValueError for dots too small to be found."""
        self._side, self._blur = dot_filters(radius)

    def __call__(self, image: Image) -> Image:
        """The picture (H, W, 3) without its dots."""
        import cv2

        inked = (local_darkness(image, self._side, self._blur) > MIN_EDGE_DARKNESS).astype(np.uint8)
        wider = cv2.dilate(inked, np.ones((3, 3), dtype=np.uint8))
        return np.asarray(cv2.inpaint(image, wider, 3.0, cv2.INPAINT_TELEA), dtype=np.uint8)


def separate_ink(picture: Image, radius: float) -> tuple[Image, Float32]:
    """The picture (H, W, 3) of an untouched gel without its dots of about `radius` [px], and (H, W, 3) the share of
    their light that they let through, 1 around them: the product is the picture. Raises ValueError for dots too small
    to be found."""
    clean = DotEraser(radius)(picture)
    share = picture.astype(np.float32) / np.maximum(clean, 1).astype(np.float32)
    return clean, np.asarray(share, dtype=np.float32)


def high_pass(picture: Float32, pixel_pitch: float) -> Float32:
    """(H, W, 3) the part of a picture that is finer than light; `pixel_pitch` [m]."""
    import cv2

    slow = cv2.GaussianBlur(picture, (0, 0), GRAIN_BLUR / pixel_pitch, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(picture - slow, dtype=np.float32)


def separate_skin(picture: Float32, share: float, pixel_pitch: float) -> tuple[Float32, Float32]:
    """The picture (H, W, 3) of an untouched gel without its skin, which is `share` of its fine part, and (H, W, 3) the
    share of light that the skin lets through, about 1: the product is the picture."""
    min_light = 1.0  # least light with which skin can be distinguished [grey levels]
    bare = picture - np.float32(share) * high_pass(picture, pixel_pitch)
    clean = np.maximum(bare, np.float32(min_light)).astype(np.float32)
    return clean, (picture / clean).astype(np.float32)

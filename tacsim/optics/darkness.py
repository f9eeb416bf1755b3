"""Height of the gel -> change of colour, for a light that tells depth and no direction (tacsim.models.darkness)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tacsim.models.darkness import DarknessModel

Float32 = NDArray[np.float32]

MAX_FINE_DEVIATION = 6.0  # standard deviation of a Gaussian [px] beyond which it is evaluated on a coarser picture


def darken_by_depth(model: DarknessModel, height: Float32, pitch: float) -> tuple[Float32, float]:
    """(H, W, 3) relative change of colour under heights (H, W) into the gel on pixels of `pitch`, in the model's unit;
    and the share of pixels that are deeper than its table."""
    own = height - np.float32(model.share) * _local_mean(height, model.reach / pitch) if model.share else height
    depths = np.array(model.depths)
    change = np.stack([np.interp(own, depths, channel) for channel in np.array(model.changes).T], axis=-1)
    return change.astype(np.float32), float(np.count_nonzero(own > depths[-1]) / own.size)


def _local_mean(height: Float32, deviation: float) -> Float32:
    """(H, W) Gaussian mean; the picture goes on as its mirror image."""
    import cv2

    coarser = max(1, int(deviation / MAX_FINE_DEVIATION))
    if coarser == 1:
        return np.asarray(cv2.GaussianBlur(height, (0, 0), deviation, borderType=cv2.BORDER_REFLECT), np.float32)
    rows, columns = height.shape
    small = cv2.resize(height, (-(-columns // coarser), -(-rows // coarser)), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), deviation / coarser, borderType=cv2.BORDER_REFLECT)
    return np.asarray(cv2.resize(small, (columns, rows), interpolation=cv2.INTER_LINEAR), np.float32)

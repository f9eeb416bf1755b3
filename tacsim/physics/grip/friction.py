"""How much of its limit of friction each contact uses, of many gels at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tacsim.physics.contact.indenter import POINTS
from tacsim.physics.pads.tuning import MIN_LEVER
from tacsim.physics.worlds.press_state import PressState

Floats = NDArray[np.float64]


def used_friction(state: PressState, gels: NDArray[np.int64], wrenches: Floats, friction: Floats) -> Floats:
    """(n, k) shares, as `tacsim.physics.pads.patch.Patches.used_friction` has it; 1 where nothing touches.

    gels: (n k,) numbers of the gels; wrenches: (n, k, 6) on the pads [N, N mm]; friction: (n,).
    """
    pressure = state.pressure[gels].astype(np.float64)
    side = state.gel[0].spacing / POINTS
    x, y = ((np.arange(count) - (count - 1) / 2) * side for count in pressure.shape[1:])
    totals = np.maximum(pressure.sum(axis=(1, 2)), np.finfo(np.float64).tiny)
    along_x, along_y = pressure.sum(axis=2), pressure.sum(axis=1)
    centre = np.stack([(along_x * x).sum(axis=1), (along_y * y).sum(axis=1)], axis=1) / totals[:, None]
    distances = np.hypot((x - centre[:, :1])[:, :, None], (y - centre[:, 1:])[:, None, :])
    levers = np.maximum((pressure * distances).sum(axis=(1, 2)) / totals, MIN_LEVER)
    flat = wrenches.reshape(-1, 6)
    twists = flat[:, 5] - (centre[:, 0] * flat[:, 1] - centre[:, 1] * flat[:, 0])
    loads = np.sqrt(flat[:, 0] ** 2 + flat[:, 1] ** 2 + (twists / levers) ** 2).reshape(wrenches.shape[:2])
    limits = friction[:, None] * np.maximum(-wrenches[..., 2], 0.0)
    return np.where(limits > 0.0, loads / np.where(limits > 0.0, limits, 1.0), 1.0)

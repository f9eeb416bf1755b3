"""Darkness -> slope, for a light that shows depth and no direction (tacsim.models.photometric)."""

from __future__ import annotations

import numpy as np

from tacsim.interface import Float32, Mask
from tacsim.models.photometric import DarknessModel


class DarknessSlopes:
    """The inverse of a darkness model on pictures of one shape: the table gives the depth beyond a share of that round
    it, a division in the cosine transform the depth itself, and differences of neighbours its slopes."""

    def __init__(self, model: DarknessModel, shape: tuple[int, int], pitch: float) -> None:
        """`shape`: rows, columns; `pitch`: distance of two pixels, in the model's unit."""
        smoothing_width = 1.0  # standard deviation of the Gaussian that takes off noise [px]
        waves = [np.pi * np.arange(count) / count for count in shape]
        square = waves[0][:, None] ** 2 + waves[1][None, :] ** 2  # [1 / px^2]
        round_it = model.share * np.exp(-square / 2 * (model.reach / pitch) ** 2)
        self._filter = (np.exp(-square / 2 * smoothing_width**2) / (1.0 - round_it)).astype(np.float32)
        self._depths = np.array(model.depths) / pitch
        self._darkness = -np.array(model.changes).mean(axis=1)

    def depth(self, change: Float32) -> tuple[Float32, Mask]:
        """(H, W) depth of relative changes (H, W, 3), and True where they are outside the table."""
        from scipy.fft import dctn, idctn

        darkness = -change.mean(axis=2)
        own = np.interp(darkness, self._darkness, self._depths).astype(np.float32)
        depth: Float32 = idctn(dctn(own, norm="ortho") * self._filter, norm="ortho")
        return depth, np.asarray((darkness < self._darkness[0]) | (darkness > self._darkness[-1]))

    def __call__(self, change: Float32) -> tuple[Float32, Mask]:
        """Slopes (H, W, 2) of relative changes (H, W, 3), and True where these are outside the table."""
        depth, beyond = self.depth(change)
        by_y, by_x = np.gradient(depth)
        return np.stack([by_x, by_y], axis=-1).astype(np.float32), beyond

"""Arrays of grips: the gels of all pads, and the object of each grip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from tacsim.compute.runtime import start_taichi
from tacsim.models.scene import Scene
from tacsim.physics.exec.lanes import PARTS
from tacsim.physics.exec.layout import STEPS
from tacsim.physics.exec.team import run_team
from tacsim.physics.grip.kernels import substeps
from tacsim.physics.grip.layout import CONSTANTS, FRAME_ROWS, OBJECT, PATCH, WHOLE
from tacsim.physics.worlds.press_state import PressState

Floats = NDArray[np.float64]


class GripState(PressState):
    """Arrays of grips that one launch advances. Gel number g of grip i is environment i * pads + g."""

    def __init__(self, scenes: Sequence[Scene], pads: int) -> None:
        """scenes: of all gels. Raises RuntimeError on a device, and what PressState raises."""
        start_taichi(cpu_only="an object held by pads")
        super().__init__(scenes)
        self.pads = pads
        grips = len(scenes) // pads
        self.constants = np.zeros((grips, CONSTANTS), np.float32)
        self.whole = np.zeros((grips, WHOLE), np.int32)
        self.objects = np.zeros((grips, OBJECT), np.float32)
        self.patches = np.zeros((len(scenes), PARTS, PATCH), np.float32)
        self.drive = np.zeros((len(scenes), 1, 1, 6, 3), np.float32)  # of the last substep

    def gels_of(self, grip: int) -> range:
        return range(grip * self.pads, (grip + 1) * self.pads)

    def advance_grips(self, frames: Mapping[int, NDArray[np.float32]]) -> None:
        """One launch of some grips, with the frames of each, see tacsim.physics.grip.layout."""
        longest = max(len(each) for each in frames.values())
        together = np.zeros((len(self.whole), longest, self.pads + 1, FRAME_ROWS, 3), np.float32)
        for index, each in frames.items():
            together[index, : len(each)] = each
        self.counts[:, STEPS] = 0
        self._gels.copy_surface()
        run_team(
            substeps, self.drive, self._gels.arguments(), (self._anchor, self._pressure, self._values),
            (self.params, self.counts, self.partial),
            (together, self.constants, self.whole, self.objects, self.patches), active=list(frames),
        )  # fmt: skip

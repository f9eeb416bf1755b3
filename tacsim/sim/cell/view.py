"""Cameras that look at a cell: a picture is rendered when it is first looked at."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Image, View
from tacsim.sim.cell.cell import Cell
from tacsim.sim.cell.clock import CellClock
from tacsim.sim.cell.scene_cell import SceneCell
from tacsim.sim.engines.mujoco_module import load_mujoco
from tacsim.sim.engines.picture import PictureRenderer


class CellView:
    """One camera of a cell. size: width, height [px]."""

    def __init__(self, scene_cell: SceneCell, clock: CellClock, name: str, size: tuple[int, int]) -> None:
        self._scene_cell, self._clock, self._name, self._size = scene_cell, clock, name, size
        self._cell: Cell | None = None  # that the renderer is of
        self._renderer: PictureRenderer | None = None

    def read(self) -> View:
        """What it sees now, rendered when it is looked at."""
        cell = self._scene_cell.cell
        state = cell.data.qpos.copy(), cell.has_pedestal
        return View(partial(self._render, cell, *state), time=self._clock.now())

    def _render(self, cell: Cell, places: NDArray[Any], has_pedestal: bool) -> Image:
        """Raises NoRendering."""
        if self._renderer is None or self._cell is not cell:
            self.close()
            self._renderer, self._cell = PictureRenderer(cell.model, self._size), cell
        mujoco, data = load_mujoco(), load_mujoco().MjData(cell.model)
        data.qpos[:] = places
        mujoco.mj_kinematics(cell.model, data)
        mujoco.mj_comPos(cell.model, data)
        mujoco.mj_camlight(cell.model, data)
        with cell.show_pedestal(present=has_pedestal):
            return np.asarray(self._renderer.render(data, self._name))

    def close(self) -> None:
        """Frees what it renders with."""
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = self._cell = None

"""The driver `skin`: its picture is darker by one grey level for each 10 µm that the gel is pressed."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from soft_touch.gantry import OPEN
from tacsim import CanonicalGrid, Check, SensorConfig, SensorDriver, SensorSpec, TactileFrame, TactileObservation

LEVEL = 10e-6  # of depth, for each grey level [m]
UNTOUCHED = 200


class SkinConfig(SensorConfig):
    driver: Literal["skin"]
    rate: Annotated[float, Field(gt=0)] = 50.0  # [Hz]
    width: int = 80  # [px]
    height: int = 60


class SkinNormaliser:
    finds_height, finds_flow = True, False

    def __init__(self, grid: CanonicalGrid) -> None:
        self._grid = grid
        self._reference: np.ndarray | None = None

    def take_reference(self, frame: TactileFrame) -> None:
        self._reference = np.asarray(frame.image, np.float32)

    def __call__(self, frame: TactileFrame, now: float) -> TactileObservation:
        assert self._reference is not None
        grid, image = self._grid, np.asarray(frame.image, np.float32)
        change = (image - self._reference) / self._reference.mean()
        height = _sampled((self._reference - image)[:, :, 0] * LEVEL, grid.rows, grid.columns).astype(np.float32)
        pixels = _sampled(change, grid.rows * grid.image_scale, grid.columns * grid.image_scale)
        valid = np.ones((grid.rows, grid.columns), np.bool_)
        return TactileObservation(
            np.clip(128 + 128 * pixels, 0, 255).astype(np.uint8),
            gradient=np.stack(np.gradient(height, grid.pitch)[::-1], axis=-1).astype(np.float32),
            height=height,
            contact=height > 2 * LEVEL,
            valid=valid,
            flow=None,
            time=frame.time,
            age=now - frame.time,
            picture=frame.image,
        )

    def diagnostics(self) -> Mapping[str, float]:
        return {}


def _sampled(values: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """The nearest pixel at each point of a grid over the whole picture."""
    down = ((np.arange(rows) + 0.5) * values.shape[0] / rows).astype(int)
    across = ((np.arange(columns) + 0.5) * values.shape[1] / columns).astype(int)
    return values[np.ix_(down, across)]


class Skin:
    def __init__(self, config: SkinConfig, spec: SensorSpec) -> None:
        self._config, self.spec = config, spec

    def read(self, timeout: float) -> TactileFrame:
        index = math.floor(time.monotonic() * self._config.rate)
        exposed = index / self._config.rate
        arm = OPEN.get(self._config.arm or "")
        depth = 0.0 if arm is None else arm.depth_at(exposed)
        image = np.full((self._config.height, self._config.width, 3), UNTOUCHED, np.uint8)
        third = self._config.height // 3, self._config.width // 3
        image[third[0] : 2 * third[0], third[1] : 2 * third[1]] -= np.uint8(min(UNTOUCHED, round(depth / LEVEL)))
        return TactileFrame(image, time=exposed, index=index)

    def close(self) -> None: ...


class SkinDriver(SensorDriver[SkinConfig]):
    config_class = SkinConfig

    def normaliser(self, untouched: Any = None) -> SkinNormaliser:
        return SkinNormaliser(self.grid)

    def spec(self, normaliser: Any) -> SensorSpec:
        return SensorSpec((self.config.height, self.config.width), height=True, flow=False, arm=self.config.arm)

    def open(self, spec: SensorSpec, companion: Any) -> Skin:
        return Skin(self.config, spec)

    def sample_rate(self) -> float:
        return self.config.rate

    def worst_latency(self) -> float:
        return 2.0 / self.config.rate

    def checks(self) -> Iterable[Check]:
        return [Check(f"{self.name}: skin", "ok", f"{self.config.rate:g} frames/s")]

    def diagnostics(self, source: Any) -> Mapping[str, float]:
        return {f"skin_temperature_{self.name}": 30.5}

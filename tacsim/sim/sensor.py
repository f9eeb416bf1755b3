"""One gel of a simulated world as a tactile sensor."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import SensorSpec, SurfaceMap, TactileFrame
from tacsim.models.scene import GelSurface
from tacsim.optics.noise import NoiseSource
from tacsim.physics.world import World
from tacsim.sim.clock import Delayed, SimClock


class SimSensor:
    """One simulated tactile sensor. A picture is rendered when it is read, once for each state of the world.

    Args:
        render: gel surface -> (H, W, 3) uint8 RGB.
        sample: gel surface -> height, gradient and flow on the canonical grid.
        noise: of its camera, drawn from the seed of the episode and the index of the frame; None: no noise.
        delay: its pictures are those of so many periods ago.
    """

    def __init__(
        self,
        world: World,
        clock: SimClock,
        frame: str,
        spec: SensorSpec,
        render: Callable[[GelSurface], NDArray[np.uint8]],
        sample: Callable[[GelSurface], SurfaceMap],
        noise: NoiseSource | None = None,
        delay: int = 0,
    ) -> None:
        self._world, self._clock, self._frame, self.spec = world, clock, frame, spec
        self._render, self._sample, self._noise = render, sample, noise
        self._past = Delayed[TactileFrame](delay)
        self._untouched: tuple[NDArray[np.uint8], SurfaceMap] | None = None
        self._index = self._episode = 0

    def read(self, timeout: float) -> TactileFrame:
        """The picture of the world now, or `delay` periods ago; `timeout` makes no difference."""
        return self._past(self._clock, self._frame_now)

    def _frame_now(self) -> TactileFrame:
        image, seen = self._look(self._world.surface(self._frame))
        if self._noise is not None:
            image = self._noise(image, self._index, self._episode)
        self._index += 1
        return TactileFrame(
            image=image,
            time=self._clock.now(),
            index=self._index - 1,
            surface=seen,
            stats=self._clock.diagnostics(),
        )

    def _look(self, surface: GelSurface) -> tuple[NDArray[np.uint8], SurfaceMap]:
        """Picture without noise, and heights. Those of an untouched gel, with which each episode begins, are kept."""
        if surface.displacement.any():
            return self._render(surface), self._sample(surface)
        if self._untouched is None:
            self._untouched = self._render(surface), self._sample(surface)
        return deepcopy(self._untouched)  # nobody writes into what is kept

    def wear(self, render: Callable[[GelSurface], NDArray[np.uint8]], noise: NoiseSource | None, delay: int) -> None:
        """Other light and another camera, from the next episode on."""
        self._render, self._noise = render, noise
        self._past, self._untouched = Delayed[TactileFrame](delay), None

    def restart(self, episode: int = 0) -> None:
        """Counts frames from zero again; `episode` seeds the noise."""
        self._past.forget()
        self._index, self._episode = 0, episode

    def close(self) -> None:
        """Nothing is held open."""

"""One gel of a simulated world as a tactile sensor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

from tacsim.interface import Image, SensorSpec, SurfaceMap, TactileFrame
from tacsim.models.scene import GelSurface
from tacsim.optics.noise import NoiseSource
from tacsim.sim.clock import Delayed, StateClock


class GelWorld(Protocol):
    """A simulated world as a sensor sees it."""

    def surface(self, name: str) -> GelSurface: ...


@dataclass
class SimCamera:
    """What the camera of a simulated sensor gives of a gel's surface.

    render: gel surface -> (H, W, 3) uint8 RGB.
    noise: drawn from the seed of the episode and the index of the frame; None: no noise.
    """

    render: Callable[[GelSurface], Image]
    noise: NoiseSource | None = None
    _untouched: Image | None = field(default=None, init=False)  # with which each episode begins

    def __call__(self, surface: GelSurface, index: int, episode: int) -> Image:
        """(H, W, 3) RGB."""
        if surface.displacement.any():
            image = self.render(surface)
        else:
            if self._untouched is None:
                self._untouched = self.render(surface)
            image = self._untouched.copy()  # the stored picture must not be written to
        return image if self.noise is None else self.noise(image, index, episode)


class SimSensor:
    """One simulated tactile sensor. A picture is rendered when it is first looked at, once for each frame.

    Args:
        render: gel surface -> (H, W, 3) uint8 RGB.
        sample: gel surface -> height, gradient and flow on the canonical grid; None: its frames have pictures only.
        noise: of its camera, drawn from the seed of the episode and the index of the frame; None: no noise.
        delay: its pictures are those of so many periods ago.
    """

    def __init__(
        self,
        world: GelWorld,
        clock: StateClock,
        frame: str,
        spec: SensorSpec,
        render: Callable[[GelSurface], Image],
        sample: Callable[[GelSurface], SurfaceMap] | None,
        noise: NoiseSource | None = None,
        delay: int = 0,
    ) -> None:
        self._world, self._clock, self._frame, self.spec = world, clock, frame, spec
        self._camera, self._sample = SimCamera(render, noise), sample
        self._past = Delayed[TactileFrame](delay)
        self._index = self._episode = 0

    def read(self, timeout: float) -> TactileFrame:
        """The picture of the world now, or `delay` periods ago; `timeout` makes no difference."""
        return self._past(self._clock, self._frame_now)

    def _frame_now(self) -> TactileFrame:
        surface = self._world.surface(self._frame)
        self._index += 1
        return TactileFrame(
            image=partial(self._camera, surface, self._index - 1, self._episode),
            time=self._clock.now(),
            index=self._index - 1,
            surface=None if self._sample is None else self._sample(surface),
            stats=self._clock.diagnostics(),
        )

    def apply_variation(self, render: Callable[[GelSurface], Image], noise: NoiseSource | None, delay: int) -> None:
        """Other light and another camera, from the next episode on."""
        self._camera, self._past = SimCamera(render, noise), Delayed[TactileFrame](delay)

    def restart(self, episode: int = 0) -> None:
        """Counts frames from zero again; `episode` seeds the noise."""
        self._past.clear()
        self._index, self._episode = 0, episode

    def close(self) -> None:
        """Nothing is held open."""

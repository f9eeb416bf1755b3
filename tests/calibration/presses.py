"""Made-up sensors with hidden lights, under a ball: frames whose true surface is known (Hertz, not the dent that the
calibrator assumes)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from calibration.light.dent import dent_slope
from tacsim.models.sensor import Light, Lighting
from tacsim.optics.render import phong_shading

ROWS, COLUMNS = 200, 260
PITCH = 0.08e-3  # [m]
BALL = 2.5e-3  # [m]
BALL_PX = BALL / PITCH


@dataclass(frozen=True)
class Made:
    """One frame and what is true of it."""

    image: np.ndarray  # (H, W, 3) uint8
    gradient: np.ndarray  # (H, W, 2)
    height: np.ndarray  # (H, W) [m]
    circle: tuple[float, float, float]  # x, y, radius [px]


class HiddenSensor:
    """Three lights of random colour, direction and gloss, an uneven background, a camera's noise. `spread` [px]: light
    spreads so far in the gel before it is seen, a Gaussian's standard deviation."""

    def __init__(self, seed: int, noise: float = 1.5, gain: float = 0.45, spread: float = 0.0) -> None:
        self._rng = np.random.default_rng(seed)
        rng, turn = self._rng, self._rng.uniform(0, 2 * np.pi)
        lights = tuple(
            Light(
                direction=(np.cos(turn + a), np.sin(turn + a), -rng.uniform(0.7, 1.0)),
                colour=tuple(gain * np.clip(np.eye(3)[i] + rng.uniform(0, 0.3, 3), 0, 1)),
                specular=rng.uniform(0, 0.2),
            )
            for i, a in enumerate((0.0, 2.2, 4.1))
        )
        self.lighting = Lighting(lights=lights, background=(0.4, 0.4, 0.4))
        v, u = np.mgrid[:ROWS, :COLUMNS]
        slope = rng.uniform(-20, 20, (2, 3))
        level = rng.uniform(90, 130, 3)
        self._base = level + (u / COLUMNS - 0.5)[..., None] * slope[0] + (v / ROWS - 0.5)[..., None] * slope[1]
        self._noise, self._spread = noise, spread

    def empty(self) -> np.ndarray:
        return self.photograph(np.zeros((ROWS, COLUMNS, 2)))

    def press(self, depth: float, x: float, y: float, drift: np.ndarray | float = 0.0, ball: float = BALL_PX) -> Made:
        """`depth` [m]; x, y: where [px]; `drift`: grey levels that are added; `ball`: its radius [px]."""
        a = np.sqrt(ball * depth / PITCH)
        v, u = np.mgrid[:ROWS, :COLUMNS].astype(float)
        r = np.hypot(u - x, v - y)
        q = np.maximum(r / a, 1.0)
        # free surface of a half-space (Johnson, eq. 3.42a); its slope is scaled to meet the ball's at the circle
        outside = depth / np.pi * ((2 - q**2) * np.arcsin(1 / q) + np.sqrt(q * q - 1))
        cap = np.sqrt(np.maximum(ball**2 - r**2, 0)) - np.sqrt(ball**2 - a**2)  # above the contact circle [px]
        height = np.where(r < a, depth / 2 + cap * PITCH, outside)  # Hertz is half as deep at the contact circle
        step = dent_slope(r, a, ball)
        gradient = -np.stack([u - x, v - y], axis=-1) * (step / np.maximum(r, 1e-9))[..., None]
        return Made(self.photograph(gradient, drift), gradient, height, (x, y, float(a)))

    def presses(self, count: int) -> list[Made]:
        """Presses of various depths all over the gel."""
        places = [(70, 60), (190, 140), (130, 100), (60, 150), (200, 60), (100, 50), (160, 60), (90, 120)]
        depths = [0.5, 0.35, 0.65, 0.45, 0.55, 0.3, 0.6, 0.4]
        jitter = self._rng.uniform(-6, 6, (8, 2))
        spread = zip(depths, places, jitter, strict=True)
        return [self.press(d * 1e-3, x + jx, y + jy) for d, (x, y), (jx, jy) in spread][:count]

    def photograph(self, gradient: np.ndarray, drift: np.ndarray | float = 0.0) -> np.ndarray:
        flat = phong_shading(np.zeros((1, 1, 2), dtype=np.float32), self.lighting)
        change = 255 * (phong_shading(gradient.astype(np.float32), self.lighting) - flat)
        if self._spread:
            change = gaussian_filter(change, (self._spread, self._spread, 0))
        noise = self._rng.normal(0, self._noise, (ROWS, COLUMNS, 3))
        return np.clip(np.rint(self._base + change + drift + noise), 0, 255).astype(np.uint8)


class DarkSensor(HiddenSensor):
    """White light from behind a translucent skin. `share`, `reach` [px]: as tacsim.models.photometric says."""

    def __init__(self, seed: int, share: float = 0.0, reach: float = 15.0, noise: float = 1.0) -> None:
        super().__init__(seed, noise)
        self._share, self._reach = share, reach
        self._base = np.full((ROWS, COLUMNS, 3), (150.0, 160.0, 155.0))

    def press(self, depth: float, x: float, y: float, drift: np.ndarray | float = 0.0, ball: float = BALL_PX) -> Made:
        made = super().press(depth, x, y, drift, ball)
        own = made.height - self._share * gaussian_filter(made.height, self._reach, mode="nearest")
        return replace(made, image=self.seen(self.darkness(own * 1e3)))

    def darkness(self, own: np.ndarray) -> np.ndarray:
        return np.where(own > 0, 0.9 * (1 - np.exp(-own)), 1.2 * own)

    def seen(self, darkness: np.ndarray) -> np.ndarray:
        noise = self._rng.normal(0, self._noise, self._base.shape)
        colour = self._base * (1 - darkness[..., None] * (1.0, 0.95, 0.9))
        return np.clip(np.rint(colour + noise), 0, 255).astype(np.uint8)

    def empty(self) -> np.ndarray:
        return self.seen(np.zeros((ROWS, COLUMNS)))

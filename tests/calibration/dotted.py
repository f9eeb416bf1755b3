"""Made-up pictures of dots whose places are known, drawn by area (8 x 8 points a pixel), not by the renderer's ramp."""

from __future__ import annotations

import numpy as np

FINE = 8


def lattice_points(rows: int, columns: int, pitch: float, angle: float = 0.0) -> np.ndarray:
    """(rows, columns, 2) centred on (0, 0), turned by `angle` [rad]."""
    x = (np.arange(columns) - (columns - 1) / 2) * pitch
    y = (np.arange(rows) - (rows - 1) / 2) * pitch
    points = np.stack(np.meshgrid(x, y), axis=-1)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return points @ turn.T


def draw(
    centres: np.ndarray,
    radius: float,
    shape: tuple[int, int] = (240, 320),
    light: np.ndarray | None = None,
    noise: float = 0.0,
    ink: float = 0.1,
) -> np.ndarray:
    """(H, W, 3) uint8: dots at `centres` (..., 2) u, v [px] on gel of `light` (H, W, 3)."""
    height, width = shape
    cover = np.zeros((height, width))
    step = (np.arange(FINE) + 0.5) / FINE - 0.5
    reach = int(np.ceil(radius)) + 1
    for u, v in np.asarray(centres, dtype=float).reshape(-1, 2):
        if not (-reach < u < width + reach and -reach < v < height + reach):
            continue
        for row in range(max(0, round(v) - reach), min(height, round(v) + reach + 1)):
            for column in range(max(0, round(u) - reach), min(width, round(u) + reach + 1)):
                away = (column + step[None, :] - u) ** 2 + (row + step[:, None] - v) ** 2
                cover[row, column] = max(cover[row, column], float((away < radius**2).mean()))
    base = np.full((height, width, 3), 110.0) if light is None else light
    rng = np.random.default_rng(int(centres.size))
    shown = base * (1 - (1 - ink) * cover)[..., None] + rng.normal(0, noise, base.shape)
    return np.clip(np.rint(shown), 0, 255).astype(np.uint8)


def uneven(shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    """Light that falls off, is another colour on each side, and has a step as the rim of a contact makes one."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    level = 90 + 70 * u / shape[1] - 30 * v / shape[0]
    level = np.where(np.hypot(u - 170, v - 110) < 55, 1.5 * level, level)
    return np.stack([level, 0.9 * level + 10, 170 - 0.5 * level], axis=-1)

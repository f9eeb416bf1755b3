"""A made-up episode with a body: a cube of particles that becomes flatter, between two gels that follow it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import ArmState, Pose, RigSpec, SensorSpec, SurfaceMap, TactileFrame
from tacsim.record.episode import MAX_DEPTH, Episode, EpisodeMeta, Step
from tacsim.report.section import GelShape

GELS = {name: GelShape((20e-3, 20e-3, 4e-3), 1e-3, name) for name in ("lower", "upper")}
SIDE = 10e-3  # of the cube [m]


def squeezed(steps: int = 4, points: int = 12, size: tuple[int, int] = (48, 64), noise: float = 0.0) -> Episode:
    """At step k the body is 1 - k/2/steps of its height, the force k N; points: along each side of the cube."""
    spec = RigSpec({name: SensorSpec(size, True, False, name) for name in GELS}, tuple(GELS), True, 0.1)
    meta = EpisodeMeta("bench", "squeeze", "scripted", 3, spec, {"tacsim": "0.1.0"}, goal=7e-3)
    random = np.random.default_rng(0).normal(0.0, max(noise, 1e-9), (*size, 3))
    axis = (np.arange(points) + 0.5) / points * SIDE - SIDE / 2
    cube = np.stack(np.meshgrid(axis, axis, axis + SIDE / 2), axis=-1).reshape(-1, 3)
    return Episode(meta, [_step(k, k / max(steps, 1), cube, random) for k in range(steps + 1)])


def without_body(episode: Episode) -> Episode:
    return Episode(episode.meta, [replace(step, body=None) for step in episode.steps])


def _step(k: int, share: float, cube: NDArray[np.float64], noise: NDArray[np.float64]) -> Step:
    height = np.zeros((20, 20), np.float32)
    height[5:15, 5:15] = share * 0.5e-3
    surface = SurfaceMap(height, np.zeros((20, 20, 2), np.float32), None)
    top = SIDE * (1 - share / 2)
    poses = {"lower": Pose(), "upper": Pose(np.array([0, 0, top]), np.array([1.0, 0, 0, 0]))}
    frames = {}
    for name in poses:
        image = 100 + np.roll(noise, 7 * k + len(name) + (name == "upper"), axis=1)
        image[10:20, 10:20, 0] += 100 * share
        frames[name] = TactileFrame(image.astype(np.uint8), time=0.1 * k, index=k, surface=surface)
    wrench = np.array([0.0, 0.0, -float(k), 0.0, 0.0, 0.0])
    return Step(
        index=k,
        time=0.1 * k,
        frames=frames,
        arms={name: ArmState(pose, np.zeros(6), wrench, None, 0.1 * k) for name, pose in poses.items()},
        action=None,
        reward=-1.0 + share,
        distance=1e-3 * (1 - share),
        info={MAX_DEPTH + name: share * 0.5e-3 for name in poses},
        seconds=0.1,
        body=(cube * np.array([1 + share / 4, 1 + share / 4, 1 - share / 2])).astype(np.float32),
    )

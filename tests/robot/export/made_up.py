"""Recordings of a simulated rig that nobody simulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tacsim import pose as se3
from tacsim.config import load_rig
from tacsim.interface import Action, ArmState, Pose, RigSpec, SensorSpec, SurfaceMap, TactileFrame
from tacsim.record.episode import EpisodeMeta, Step
from tacsim.record.images import encode_png
from tacsim.record.writer import Recorder

PERIOD = 0.1
NAMES = ("lower", "upper")
LOADED = load_rig("sim")
SHAPE = (LOADED.config.sensors["lower"].model.geometry.height, LOADED.config.sensors["lower"].model.geometry.width)


def turned(rng: np.random.Generator, size: float) -> Pose:
    return se3.from_rotation_vector(rng.normal(0.0, size, 3), rng.normal(0.0, size, 3))


def made_up_step(index: int, names: Sequence[str], seed: int) -> Step:
    """Of a simulated rig: pictures near grey, surfaces and poses at random."""
    rng = np.random.default_rng((seed, index))

    def frame() -> TactileFrame:
        height = np.zeros((64, 64), np.float32)
        height[12:-12, 12:-12] = rng.normal(0.0, 1e-3, (40, 40))  # well inside the gel
        surface = SurfaceMap(
            height=height,
            gradient=rng.normal(size=(64, 64, 2)).astype(np.float32),
            flow=rng.normal(0.0, 1e-4, (5, 7, 2)).astype(np.float32),
        )
        image = rng.integers(90, 160, (*SHAPE, 3), dtype=np.uint8)
        return TactileFrame(image, time=PERIOD * index, index=index, surface=surface)

    def arm() -> ArmState:
        return ArmState(turned(rng, 0.1), rng.normal(size=6), rng.normal(size=6), None, PERIOD * index)

    asked: dict[str, Pose | None] = {name: turned(rng, 0.1) for name in names}
    if index == 3:  # the upper arm holds
        asked[names[-1]] = None
    return Step(
        index=index,
        time=PERIOD * index,
        frames={name: frame() for name in names},
        arms={name: arm() for name in names},
        action=None if index == 0 else Action(asked),
        reward=-0.1 * index,
        distance=1e-3,
    )


def record(
    path: str, steps: int = 5, *, names: Sequence[str] = NAMES, seed: int = 0, **facts: object
) -> tuple[Path, list[Step]]:
    sensors = {name: SensorSpec(SHAPE, height=True, flow=True, arm=name) for name in names}
    reference = encode_png(np.full((*SHAPE, 3), 120, np.uint8))
    meta = EpisodeMeta(
        rig="sim",
        task="squeeze",
        policy="scripted",
        seed=seed,
        spec=RigSpec(sensors, tuple(names), truth=True, period=PERIOD),
        versions={"tacsim": "0.2.0"},
        attachments={"rig.yaml": LOADED.text.encode(), **{f"reference/{name}.png": reference for name in names}},
        goal=7e-3,
    )
    made = [made_up_step(k, names, seed) for k in range(steps)]
    with Recorder(path, replace(meta, **facts)) as recorder:
        for step in made:
            assert recorder.write(step) and recorder.flush()
    return Path(path), made

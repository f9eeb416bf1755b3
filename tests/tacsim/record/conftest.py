"""Steps and facts of a small made-up episode; a folder of pictures and a video."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path

import cv2
import numpy as np
import pytest

from tacsim.interface import (
    Action,
    ArmState,
    GripperState,
    GripperTarget,
    Pose,
    RigSpec,
    SensorSpec,
    SurfaceMap,
    TactileFrame,
)
from tacsim.record.episode import ArmPackages, EpisodeMeta, Step
from tacsim.record.images import encode_png
from tests.tacsim.record.replayed import picture


def random_pose(rng: np.random.Generator) -> Pose:
    quaternion = rng.normal(size=4)
    return Pose(rng.normal(size=3), quaternion / np.linalg.norm(quaternion))


def random_surface(rng: np.random.Generator, size: tuple[int, int], flow: bool) -> SurfaceMap:
    return SurfaceMap(
        height=rng.normal(size=size).astype(np.float32),
        gradient=rng.normal(size=(*size, 2)).astype(np.float32),
        flow=rng.normal(size=(3, 4, 2)).astype(np.float32) if flow else None,
    )


def random_packages(rng: np.random.Generator, count: int, time: float) -> ArmPackages:
    times = {name: time - 2e-3 * rng.random(count) for name in ("time", "stamp")}
    vectors = ("joints", "joint_speeds", "tcp_pose", "tcp_speed", "tcp_force")
    whole = {name: rng.integers(0, 99, count) for name in ("runtime_state", "safety_bits", "status")}
    return ArmPackages.from_columns(times | {name: rng.normal(size=(count, 6)) for name in vectors} | whole, lost=count)


def random_step(
    index: int,
    image: tuple[int, int] = (24, 32),
    grid: tuple[int, int] = (6, 5),
    packages: bool = False,
    body: bool = False,
) -> Step:
    """Sensor "lower" with everything, "upper" without flow, "side" without a surface; arms with and without joints."""
    rng = np.random.default_rng(index)
    time = 0.1 * index + 1 / 3

    def frame(surface: SurfaceMap | None) -> TactileFrame:
        pixels = rng.integers(0, 256, (*image, 3), dtype=np.uint8)
        return TactileFrame(image=pixels, time=time - 0.0123456789, index=3 * index, surface=surface)

    def arm(joints: bool) -> ArmState:
        angles = rng.normal(size=6) if joints else None
        return ArmState(random_pose(rng), rng.normal(size=6), rng.normal(size=6), angles, time - 1e-3)

    surfaces = {"lower": random_surface(rng, grid, True), "upper": random_surface(rng, grid, False), "side": None}
    return Step(
        index=index,
        time=time,
        frames={name: frame(surface) for name, surface in surfaces.items()},
        arms={"lower": arm(joints=False), "upper": arm(joints=True)},
        action=None
        if index == 0
        else Action(
            {"upper": random_pose(rng), "lower": None}, {"hand": GripperTarget(0.0, float(rng.uniform())), "foot": None}
        ),
        sent={"upper": None if index == 0 else random_pose(rng), "lower": None},
        reward=None if index == 0 else float(rng.normal()),
        distance=None if index == 0 else float(rng.normal()),
        info={"residual": float(rng.normal()), "worst": float("nan"), "most": float("inf"), "hits": 1.0},
        seconds=float(rng.uniform()),
        grippers={
            "hand": GripperState(float(rng.uniform()), float(rng.uniform()), time - 2e-3),
            "foot": GripperState(0.0, None, time),
        },
        sent_grippers={} if index == 0 else {"hand": GripperTarget(0.01, 0.0), "foot": None},
        packages={"upper": random_packages(rng, 3 * index, time)} if packages else {},
        body=rng.normal(size=(40 + index, 3)).astype(np.float32) if body else None,
    )


@pytest.fixture
def make_step() -> Callable[..., Step]:
    return random_step


@pytest.fixture
def meta() -> EpisodeMeta:
    sensors = {
        "lower": SensorSpec((24, 32), height=True, flow=True, arm="lower"),
        "upper": SensorSpec((24, 32), height=True, flow=False, arm="upper"),
        "side": SensorSpec((24, 32), height=False, flow=False, arm=None),
    }
    return EpisodeMeta(
        rig="sim",
        task="squeeze",
        policy="scripted",
        seed=7,
        spec=RigSpec(sensors=sensors, arms=("lower", "upper"), truth=True, period=0.1, grippers=("hand", "foot")),
        versions={"tacsim": "0.2.0", "numpy": "2.4"},
        attachments={"rig.yaml": b"name: sim\n", "calibration/lower.npz": bytes(range(256)), "empty": b""},
        goal=(2e-3, 1 / 3),
        started=datetime(2026, 3, 4, 5, 6, 7, 891234, timezone(timedelta(hours=-3, minutes=-30))),
        wall_offset=1_772_610_000_123_456_789,
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "pictures"
    path.mkdir()
    for k in (10, 9, 1, 2):
        (path / f"frame_{k}.png").write_bytes(encode_png(picture(k)))
    (path / "notes.txt").write_text("no picture")
    return path


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "v.avi"
    out = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    assert out.isOpened()
    for k in range(5):
        out.write(cv2.cvtColor(picture(k, (48, 64)), cv2.COLOR_RGB2BGR))
    out.release()
    return path

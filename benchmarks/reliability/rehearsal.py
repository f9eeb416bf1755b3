"""What the reliability cases share: mock controllers, the true driver on them, and somebody who watches from the side.

Times are read where they arise: the worker stamps every record in the shared memory with the monotonic clock and the
controller's own clock, and the mock counts in which control period a command arrived. So a figure says how late the
arm was, not how late the one who measured it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from benchmarks.reliability.repeated import Disturbed
from robot.arm import shared_ring
from robot.arm.channel import HISTORY, Channel
from robot.arm.shared_ring import Record
from robot.arm.ur import URArm
from robot.common.kinematics import Kinematics
from robot.common.loopback import loopback_host
from robot.mock import Input, MockState, MockUR
from robot.mock.ur.machine.arm import HOME
from tacsim import pose as se3
from tacsim.interface import FloatArray, Pose
from tacsim.models.hardware import ArmLimits, MockArmConfig, Placement, Plane, UrArmConfig, Workspace

ROOM = 24  # second number of the loopback addresses
PATIENCE = 20.0  # for anything that has to happen [s]
SERVO = 11  # number of the servoJ command in the registers
STILL = 1e-3  # slower than this an arm stands [m/s]
KINEMATICS = Kinematics("ur5e")
SPEED = 0.1  # of the arm, unless a case says otherwise [m/s]
BASE = Placement(position=(0.2, -0.1, 0.05), rotation=(0.0, 0.0, 0.5))
TOOL = Placement(position=(0.0, 0.0, 0.03), rotation=(0.1, 0.0, 0.0))
SENSOR = Placement(position=(0.01, 0.0, 0.05), rotation=(0.0, 0.0, 0.3))
FLANGE_FROM_SENSOR = se3.to_matrix(se3.compose(TOOL.pose, SENSOR.pose))
START: FloatArray = (se3.to_matrix(BASE.pose) @ KINEMATICS.forward(HOME) @ FLANGE_FROM_SENSOR)[:3, 3]  # [m]
REACH = 0.15  # half the side of the box round the start [m]
SLOPE = Plane(point=(START[0], START[1], START[2] - 0.05), normal=(0.3, 0.0, 1.0))


class MissingDriver(RuntimeError):
    """ur_rtde is not installed."""


def host(number: int) -> str:
    """A loopback address of this process's own."""
    return loopback_host(number, ROOM)


def config(at: str, limits: Mapping[str, object] | None = None, **changes: object) -> UrArmConfig:
    """An arm whose time-outs are so long that a busy machine is no fault; a case that measures one names its own."""
    box = Workspace.model_validate({"lower": (START - REACH).tolist(), "upper": (START + REACH).tolist()})
    made = UrArmConfig(
        driver="ur",
        host=at,
        world_from_base=BASE,
        flange_from_tool=TOOL,
        tool_from_sensor=SENSOR,
        limits=ArmLimits.model_validate({"workspace": box, "speed": SPEED, **(limits or {})}),
        link_timeout=1.0,
        action_timeout=30.0,
        mock=MockArmConfig(realtime=True),
    )
    return made.model_copy(update={"watchdog": 1.0, **changes})


def moved(pose: Pose, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Pose:
    return Pose(pose.position + [x, y, z], pose.quaternion)


def until(done: Callable[[], bool], what: str, pause: float = 1e-3) -> float:
    """Waits; returns when it was seen to be so, by the monotonic clock [s]. Raises TimeoutError."""
    deadline = time.monotonic() + PATIENCE
    while not done():
        if time.monotonic() > deadline:
            raise TimeoutError(f"{what}: not within {PATIENCE:g} s")
        time.sleep(pause)
    return time.monotonic()


@contextmanager
def mock_arm(number: int = 1) -> Iterator[MockUR]:
    """A mock controller. Raises MissingDriver where the driver could not talk to it anyway."""
    if find_spec("rtde_control") is None:
        raise MissingDriver("ur_rtde has no wheel for this Python and machine; use Python 3.11 or 3.12 on x86-64")
    with MockUR(host(number), realtime=True) as mock:
        yield mock


class Watcher:
    """Reads the records of an open arm's worker, as a stranger to its driver. A context manager."""

    def __init__(self, name: str) -> None:
        self._segment = shared_ring.attach(shared_ring.segment_name(os.getpid(), name))
        self.link: Channel | None = Channel(self._segment)

    def newest(self) -> Record:
        assert self.link is not None
        record = self.link.states.latest()
        assert record is not None
        return record

    def records(self, number: int = HISTORY) -> Record:
        """The last records, oldest first: at least one a package, two seconds at most."""
        assert self.link is not None
        records = self.link.states.recent(number)
        kept: Record = records[records["stamp"] != 0.0]
        return kept  # without those before the first package

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.link = None
        self._segment.close()


@contextmanager
def driven(mock: MockUR, given: UrArmConfig | None = None, name: str = "bench") -> Iterator[tuple[URArm, Watcher]]:
    """The driver on a mock that is as at power-on."""
    mock.faults.reset()
    with URArm(config(mock.host) if given is None else given, name) as arm, Watcher(name) as watcher:
        yield arm, watcher


def under_way(arm: URArm, target: Pose) -> None:
    """Commands `target`; comes back when the arm has gone one and a half times the way that it takes to full speed.

    (Not when a speed is measured: a loop that misses periods on a busy machine does not make up for them.)"""
    limits, start = arm.config.limits, arm.state().pose.position
    way = 0.75 * limits.speed**2 / limits.acceleration
    arm.command(target)
    until(lambda: sound(arm) and float(np.linalg.norm(arm.state().pose.position - start)) > way, "full speed")


def sound(arm: URArm) -> bool:
    """True; raises Disturbed for an arm that stopped for a reason the case did not ask for."""
    if arm.status().is_fault:
        raise Disturbed(f"{arm.explain()}. Nothing in the case asks for it; is the machine busy?")
    return True


def still(state: MockState) -> bool:
    """True if the tool of a mock stands."""
    return float(np.linalg.norm(state.tcp_speed[:3])) < STILL


def shift(one: MockState, other: MockState) -> float:
    """How far the tool went from one state to the other [m]."""
    return float(np.linalg.norm(np.subtract(one.pose[:3], other.pose[:3])))


def servo_targets(entries: tuple[Input, ...]) -> tuple[FloatArray, FloatArray]:
    """Of the servoJ calls among received packages: control periods (n,) and joints (n, 6)."""
    calls = [entry for entry in entries if entry.values.get("input_int_register_0") == SERVO]
    joints = [[entry.values[f"input_double_register_{k}"] for k in range(6)] for entry in calls]
    return np.array([entry.tick for entry in calls]), np.array(joints, dtype=np.float64).reshape(-1, 6)


def sensor_path(joints: FloatArray) -> FloatArray:
    """Origins (n, 3) of the sensor in the world at joint targets (n, 6), by forward kinematics alone."""
    base = se3.to_matrix(BASE.pose)
    return np.array([(base @ KINEMATICS.forward(q) @ FLANGE_FROM_SENSOR)[:3, 3] for q in joints]).reshape(-1, 3)


def workers(parent: int) -> list[int]:
    """Process numbers of the workers that process `parent` started (Linux)."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                above = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                words = (entry / "cmdline").read_bytes().split(b"\0")
            except OSError:  # it has ended meanwhile
                continue
            if above == parent and b"robot.arm.worker" in words:
                found.append(int(entry.name))
    return found


def segments(owner: int) -> int:
    """How many pieces of shared memory of process `owner` there are."""
    return len(list(shared_ring.FOLDER.glob(f"{shared_ring.PREFIX}-{owner}-*")))


def hostile(rng: np.random.Generator, number: int, bad: float = 0.4, run: int = 1) -> FloatArray:
    """(number, 7) targets round the start, up to 0.4 m away; a share `bad` of them with a number that is none, or huge.
    `run` of them in a row lie in one place, so that an arm gets there."""
    rows = np.empty((number, 7))
    places = START + rng.uniform(-0.4, 0.4, (-(-number // run), 3))
    rows[:, :3] = places.repeat(run, axis=0)[:number]
    turns = rng.normal(size=(number, 4)) * (1.0 if run == 1 else 0.1) + [1.0, 0.0, 0.0, 0.0]
    rows[:, 3:] = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    spoilt = np.flatnonzero(rng.random(number) < bad)
    poison = rng.choice([np.nan, np.inf, -np.inf, 1e308, -1e9, 5.0], len(spoilt))
    rows[spoilt, rng.integers(0, 7, len(spoilt))] = poison
    return rows

"""Data exchanged by the driver of an arm and its worker process: one configuration, made of the arm's in the rig file,
then records both ways, in rings of shared memory.

A record is written into the next slot and counted after that. A reader copies the newest counted slot and reads the
count again: the copy is consistent unless the writer has reached that slot in between. It is a sequence lock: the
writer never waits, readers rarely repeat, and the last records stay available.

It relies on the memory order of x86-64, which keeps the order of stores and of loads (Intel SDM 3A, 8.2.2), and in
which an aligned 8-byte store is atomic. ur_rtde has wheels for x86-64 only; on others :func:`create_segment` raises.

A segment is memory with a descriptor and without a name. A child process gets it by that number (`pass_fds`); no other
process can open or replace it. The kernel frees it when the last process that holds it ends, in whatever way.
"""

from __future__ import annotations

import fcntl
import math
import mmap
import os
import platform
import tempfile
import threading
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from robot.common import MOCK_SERIAL, is_loopback
from robot.common.kinematics import pose
from robot.common.tcp import ArmFrames
from robot.errors import DeviceNotConnectedError
from tacsim import pose as se3
from tacsim.interface import FloatArray

if TYPE_CHECKING:
    from tacsim.models.hardware import UrArmConfig

_HEADER_SIZE = 64  # bytes before the slots: the count, on a cache line of its own

Record = NDArray[np.void]  # one record (shape ()) or several (n,)

HISTORY = 1024  # state records in memory: two seconds
STATISTICS_PERIODS = 500  # periods in the statistics of a worker
COMMAND_SLOTS = 8
TACTILE_SLOTS = 8


class Ring:
    """The last `slots` records of type `record` in `memory`; new memory is zeroed."""

    def __init__(self, memory: memoryview | mmap.mmap, record: np.dtype[np.void], slots: int) -> None:
        self._count: NDArray[np.uint64] = np.ndarray((1,), np.uint64, memory)
        # As plain bytes: NumPy copies records field by field, twenty times slower.
        self._record, self._bytes = record, np.dtype((np.void, record.itemsize))
        self._slots: Record = np.ndarray((slots,), self._bytes, memory, offset=_HEADER_SIZE)

    @staticmethod
    def size(record: np.dtype[np.void], slots: int) -> int:
        """Size of a ring in memory [bytes], a multiple of a cache line."""
        return _HEADER_SIZE + -(-record.itemsize * slots // _HEADER_SIZE) * _HEADER_SIZE

    @property
    def count(self) -> int:
        """Number of records written so far."""
        return int(self._count[0])

    def write(self, record: Record) -> None:
        """Adds a record. Only one thread of one process may write."""
        count = int(self._count[0])
        self._slots[count % len(self._slots)] = np.asarray(record, self._record).view(self._bytes)
        self._count[0] = count + 1  # readers see it from here on

    def latest(self) -> Record | None:
        """A copy of the newest record, None before the first."""
        return self.newest()[1]

    def newest(self) -> tuple[int, Record | None]:
        """The newest record and its number, counted from 1; 0 and None before the first. (Reading `count` separately
        could give the number of a later record.)"""
        while count := int(self._count[0]):
            slot = (count - 1) % len(self._slots)
            copy: Record = self._slots[slot : slot + 1].copy().view(self._record).reshape(())
            if int(self._count[0]) - count < len(self._slots) - 1:  # otherwise the writer may be in this slot
                return count, copy
        return 0, None

    def recent(self, number: int) -> Record:
        """Copies of the newest records (n,), at most `number`, oldest first."""
        count = self.count
        return self._copy_records(count - number, count)

    def since(self, number: int) -> tuple[int, Record]:
        """The number of the newest record, and copies of those after `number` (counted from 1) that the ring still has,
        oldest first."""
        count = self.count
        return count, self._copy_records(number, count)

    def _copy_records(self, after: int, last: int) -> Record:
        """Copies of the records after number `after` up to number `last` that the ring still has."""
        slots = len(self._slots)
        index = np.arange(max(0, after, last - (slots - 1)), last)
        copies = self._slots[index % slots]
        whole = index > self.count - slots
        intact: Record = copies[whole].view(self._record)
        return intact


class Segment:
    """The shared memory of `descriptor`, which is closed with the last reference; a ring keeps the memory mapped."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        weakref.finalize(self, os.close, descriptor)
        self.memory = mmap.mmap(descriptor, 0)


def create_segment(size: int) -> Segment:
    """Creates a zeroed segment. Raises OSError without such memory, or on a processor other than x86-64."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        raise OSError(f"records in shared memory need the store order of x86-64; this is {platform.machine()}")
    with (
        os.fdopen(os.memfd_create("tacsim"), "w+b") if hasattr(os, "memfd_create") else tempfile.TemporaryFile() as file
    ):
        file.truncate(size)
        if hasattr(os, "posix_fallocate"):  # missing memory is an error here, not a bus error later
            os.posix_fallocate(file.fileno(), 0, size)
        # Above 2: these are the standard streams of a child, even if this program was started without them.
        return Segment(fcntl.fcntl(file.fileno(), fcntl.F_DUPFD_CLOEXEC, 3))


class CommandKind(IntEnum):
    HOLD = 0
    TARGET = 1
    ZERO_WRENCH = 2
    CLOSE = 3
    CONTINUE_TO_START = 4  # along the path to the start; only an arm that was opened for it accepts this


@dataclass(frozen=True, slots=True)
class Timing:
    """Periods of the servo loop, over the last 500."""

    median: float  # of the period [s]
    p99: float
    max_period: float
    overruns: int  # missed periods of this worker
    cycles: int  # periods of this worker


# One controller package and the worker's status. Written every period, and again as soon as a fault is found.
STATE = np.dtype(
    [
        ("time", np.float64),  # when the package was read, monotonic clock [s]
        ("written", np.float64),  # when this record was written, monotonic clock [s]
        ("stamp", np.float64),  # time on the controller's own clock [s]
        ("joints", np.float64, 6),  # [rad]
        ("joint_speeds", np.float64, 6),  # [rad/s]
        ("tcp_pose", np.float64, 6),  # base axes, position and rotation vector [m, rad]
        ("tcp_speed", np.float64, 6),  # [m/s, rad/s]
        ("tcp_force", np.float64, 6),  # [N, N m]
        ("position", np.float64, 3),  # of the sensor in the world [m]
        ("stopping_point", np.float64, 3),  # where the sensor would come to rest if it braked now [m]
        ("target", np.float64, 3),  # position of the servo target [m]
        ("top_speed", np.float64),  # limits.speed [m/s]
        ("runtime_state", np.int64),  # of the controller's program
        ("safety_bits", np.int64),  # safety_status_bits of the controller
        ("status", np.int64),
        ("resting", np.int64),  # the servo target is at rest
        ("commands_read", np.int64),  # commands read by this worker
        ("zeroed", np.int64),  # times that this worker has zeroed the wrench
        ("rejected", np.int64),  # targets that were not poses
        ("clipped", np.int64),  # targets clipped to the workspace
        ("busy_until", np.float64),  # latest end of a call to the controller that takes long [s]
        ("cycles", np.int64),  # periods of this worker
        ("overruns", np.int64),  # missed periods
        ("period", np.float64, 3),  # median, 99th percentile and maximum of 500 periods, updated every 500 [s]
        ("late", np.int64),  # periods among the last 500 that took two or more
        ("longest", np.float64),  # longest of the last 500 periods [s]
        ("realtime", np.int64),  # 1: the worker has real-time priority
    ]
)
COMMAND = np.dtype(
    [
        ("time", np.float64),
        ("kind", np.int64),
        ("target", np.float64, 7),  # position, quaternion x y z w
        ("speed", np.float64),  # maximum, in addition to limits.speed [m/s]
        ("fraction", np.float64),  # of the path to the start, 0 to 1: move up to there
    ]
)
# Report of the driver after every observation: exposure time of the oldest picture (NaN: the guard by pictures is off),
# indentation depth and shear of the arm's own gel (NaN: unknown).
TACTILE = np.dtype([("exposed", np.float64), ("depth", np.float64), ("shear", np.float64)])


@dataclass(frozen=True)
class Partner:
    """The other arm of a keep-out."""

    segment: int  # descriptor of its memory
    distance: float  # [m]


@dataclass(frozen=True)
class WorkerConfig:
    """Configuration of a worker, in plain numbers: without pydantic and SciPy the worker starts quickly."""

    name: str
    host: str
    model: str
    refused_serial: str | None  # serial number of a mock controller; set for a real arm
    realtime: bool  # ask for real-time priority
    parent: int  # process id of the driver
    segment: int  # descriptor of its memory
    world_from_base: list[list[float]]
    flange_from_tool: list[list[float]]
    tool_from_sensor: list[list[float]]
    tcp: list[float]  # flange_from_tool as a UR pose
    mass: float
    mass_centre: list[float]
    lower: list[float]
    upper: list[float]
    planes: list[list[list[float]]]
    speed: float
    turn_rate: float
    acceleration: float
    turn_acceleration: float
    joint_speed: float
    force: float
    torque: float
    following_error: float
    following_turn: float
    depth: float | None
    shear: float | None
    link_timeout: float
    action_timeout: float
    observation_timeout: float
    watchdog: float
    lookahead: float
    gain: float
    partners: list[Partner]
    serial: str | None = None  # of the robot; None: any
    start_path: list[list[float]] | None = (
        None  # joints (2, 6): the arm may only move straight from the first to the second
    )

    @property
    def frames(self) -> ArmFrames:
        fixed = (self.world_from_base, self.flange_from_tool, self.tool_from_sensor)
        return ArmFrames(*map(np.array, fixed))

    @staticmethod
    def from_dict(given: dict[str, Any]) -> WorkerConfig:
        """From the dictionary that `asdict` returns, after JSON."""
        return WorkerConfig(**{**given, "partners": [Partner(**partner) for partner in given["partners"]]})


class Channel:
    """The shared memory of one arm: states from its worker, commands and tactile reports from its driver. Without a
    segment (None: a closed arm) it is empty."""

    _STATES = Ring.size(STATE, HISTORY)
    _BOTH = _STATES + Ring.size(COMMAND, COMMAND_SLOTS)
    SIZE = _BOTH + Ring.size(TACTILE, TACTILE_SLOTS)

    def __init__(self, segment: Segment | None) -> None:
        view = memoryview(bytearray(self.SIZE) if segment is None else segment.memory)
        self.states = Ring(view[: self._STATES], STATE, HISTORY)
        self.commands = Ring(view[self._STATES : self._BOTH], COMMAND, COMMAND_SLOTS)
        self.tactile = Ring(view[self._BOTH :], TACTILE, TACTILE_SLOTS)


_segments: WeakValueDictionary[str, Segment] = WeakValueDictionary()
_segments_lock = threading.Lock()


def shared_segment(arm: str) -> Segment:
    """The memory of an arm of this process. It is created when this arm or another arm of its keep-out is opened, and
    freed when none of them is open. Raises OSError."""
    with _segments_lock:
        segment = _segments.get(arm) or create_segment(Channel.SIZE)
        _segments[arm] = segment
        return segment


def make_command_record(
    time: float, kind: CommandKind, target: FloatArray | None = None, speed: float = math.inf, fraction: float = 0.0
) -> Record:
    """A command record: `target` (7,) and max `speed` [m/s] for TARGET, `fraction` for CONTINUE_TO_START."""
    return np.array((time, kind, np.zeros(7) if target is None else target, speed, fraction), COMMAND)


def make_tactile_record(exposed: float, depth: float, shear: float) -> Record:
    """A tactile report record; see TACTILE."""
    return np.array((exposed, depth, shear), TACTILE)


def check_host(config: UrArmConfig, name: str) -> None:
    """Raises DeviceNotConnectedError unless a mock or simulator is on loopback and a real arm is not."""
    loopback = is_loopback(config.host)
    if config.mock is not None and not loopback:
        raise DeviceNotConnectedError(
            f"arm '{name}' has a `mock:` block, but its host {config.host} is outside this machine; a mock's host is a "
            "loopback address such as 127.0.0.2. Remove `mock:` to talk to the real arm"
        )
    if config.simulator and not loopback:
        raise DeviceNotConnectedError(
            f"arm '{name}' is declared as a simulator (`simulator: true`), but its host {config.host} is outside this "
            "machine, where a real arm may answer; remove `simulator: true`, or give the simulator's loopback address"
        )
    if config.mock is None and not config.simulator and loopback:
        raise DeviceNotConnectedError(
            f"arm '{name}' is a real arm, but its host {config.host} is this machine; give its address, or add `mock: "
            "{}` for a mock controller, or `simulator: true` for the maker's simulator (URSim)"
        )


def make_worker_config(
    config: UrArmConfig,
    name: str,
    segment: int,
    partners: Sequence[Partner],
    start_path: tuple[FloatArray, FloatArray] | None = None,
) -> WorkerConfig:
    """`start_path`: joints (6,) at both ends of the only allowed path, straight; None: it follows commands."""
    limits, tool = config.limits, se3.to_matrix(config.flange_from_tool.pose)
    return WorkerConfig(
        name=name,
        host=config.host,
        model=config.model,
        refused_serial=MOCK_SERIAL if config.mock is None else None,
        # URSim shares this machine: a worker with real-time priority would slow it down.
        realtime=not config.simulator if config.mock is None else config.mock.realtime,
        parent=os.getpid(),
        segment=segment,
        world_from_base=se3.to_matrix(config.world_from_base.pose).tolist(),
        flange_from_tool=tool.tolist(),
        tool_from_sensor=se3.to_matrix(config.tool_from_sensor.pose).tolist(),
        tcp=pose(tool).tolist(),
        mass=config.payload.mass,
        mass_centre=list(config.payload.centre),
        lower=list(limits.workspace.lower),
        upper=list(limits.workspace.upper),
        planes=[[list(wall.point), list(wall.normal)] for wall in limits.planes],
        speed=limits.speed,
        turn_rate=limits.turn_rate,
        acceleration=limits.acceleration,
        turn_acceleration=limits.turn_acceleration,
        joint_speed=limits.joint_speed,
        force=limits.force,
        torque=limits.torque,
        following_error=limits.max_following_error,
        following_turn=limits.max_following_turn,
        depth=limits.depth,
        shear=limits.shear,
        link_timeout=config.link_timeout,
        action_timeout=config.action_timeout,
        observation_timeout=config.observation_timeout,
        watchdog=config.watchdog,
        lookahead=config.lookahead,
        gain=config.gain,
        partners=list(partners),
        serial=config.serial,
        start_path=None if start_path is None else [end.tolist() for end in start_path],
    )

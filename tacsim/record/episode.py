"""An episode: what the recorder writes, the reader gives back, and the report shows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Generic, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Action, ArmState, FloatArray, Pose, RigSpec, TactileFrame

T = TypeVar("T")
_VECTORS = ("joints", "joint_speeds", "tcp_pose", "tcp_speed", "tcp_force")


class EpisodeError(ValueError):
    """A recording that is missing, damaged, of another kind, or beyond the limits of size."""


@dataclass(frozen=True, slots=True, eq=False)
class ArmPackages:
    """What an arm's controller sent during a control step: a row for each package, oldest first, as it came (base axes,
    not those of the sensor)."""

    time: FloatArray  # (n,) when it was read, rig clock [s]
    stamp: FloatArray  # (n,) time on the controller's own clock [s]
    joints: FloatArray  # (n, 6) [rad]
    joint_speeds: FloatArray  # (n, 6) [rad/s]
    tcp_pose: FloatArray  # (n, 6) position and rotation vector [m, rad]
    tcp_speed: FloatArray  # (n, 6) [m/s, rad/s]
    tcp_force: FloatArray  # (n, 6) [N, N m]
    runtime_state: NDArray[np.int64]  # (n,) of the controller's program: 1 stopped, 2 playing, 4 paused
    safety_bits: NDArray[np.int64]  # (n,) safety_status_bits of the controller
    status: NDArray[np.int64]  # (n,) what the driver made of it: robot.ArmStatus
    lost: int = 0  # packages missing among these, or between these and those of the step before

    @classmethod
    def of(cls, columns: Mapping[str, Any] | NDArray[np.void], lost: int = 0) -> Self:
        """From sequences with the names of the fields, or a structured array."""
        arrays: dict[str, Any] = {name: np.array(columns[name], np.float64) for name in ("time", "stamp")}
        arrays |= {name: np.array(columns[name], np.float64).reshape(-1, 6) for name in _VECTORS}
        arrays |= {name: np.array(columns[name], np.int64) for name in ("runtime_state", "safety_bits", "status")}
        return cls(**arrays, lost=lost)


class Recorded(Mapping[str, T], Generic[T]):
    """Parts of a recorded step by name: each is decoded when it is asked for, and not kept.

    known: by name, what the record says without decoding: exposure of a frame [s], number of an arm's packages lost.
    Raises EpisodeError, when a part is asked for, if it cannot be decoded.
    """

    def __init__(self, known: Mapping[str, float], decode: Callable[[str], T]) -> None:
        self.known, self._decode = known, decode

    def __getitem__(self, name: str) -> T:
        if name not in self.known:
            raise KeyError(name)
        return self._decode(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self.known)

    def __len__(self) -> int:
        return len(self.known)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One control step: the action, and what the rig delivered after it. Step 0 follows reset and has no action."""

    index: int
    time: float  # of the observation, rig clock [s]
    frames: Mapping[str, TactileFrame]  # native, by sensor
    arms: Mapping[str, ArmState]
    action: Action | None = None  # asked
    sent: Mapping[str, Pose | None] = field(default_factory=dict)  # executed, by arm
    reward: float | None = None
    distance: float | None = None  # from the goal [m]
    info: Mapping[str, float] = field(default_factory=dict)  # e.g. body_height, contact_signal_upper, residual
    seconds: float = 0.0  # wall time of the step [s]
    packages: Mapping[str, ArmPackages] = field(default_factory=dict)  # by arm, where the rig file asks for them
    body: NDArray[np.float32] | None = None  # (n, 3) particles of a simulated body, where it does; world [m]

    @property
    def exposed(self) -> Mapping[str, float]:
        """When each frame was exposed [s]; decodes none."""
        if isinstance(self.frames, Recorded):
            return self.frames.known
        return {name: frame.time for name, frame in self.frames.items()}


@dataclass(frozen=True, slots=True, eq=False)
class EpisodeMeta:
    """What holds for the whole episode."""

    rig: str
    task: str | None
    policy: str
    seed: int
    spec: RigSpec
    versions: Mapping[str, str]
    attachments: Mapping[str, bytes] = field(default_factory=dict)  # name -> content: rig.yaml, calibration bundles
    goal: float | tuple[float, ...] | None = None
    started: datetime | None = None  # with its time zone
    wall_offset: int = 0  # wall clock minus the rig's clock, measured at the start [ns]


@dataclass(slots=True, eq=False)
class Episode:
    """The steps of an episode: in memory, or in its recording, from where each is read when it is asked for."""

    meta: EpisodeMeta
    steps: Sequence[Step] = field(default_factory=list)
    complete: bool = True  # False: the recorder was killed; the steps flushed until then are here
    dropped: int = 0  # steps that the recorder had to drop

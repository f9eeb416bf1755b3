"""An episode: written by the recorder, returned by the reader, shown by the report; and the keys of `Step.info`:
numbers of a step in addition to frames, states and actions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Generic, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import (
    Action,
    ArmState,
    FloatArray,
    GripperState,
    GripperTarget,
    Pose,
    RigSpec,
    TactileFrame,
    short_repr,
)

T = TypeVar("T")
_VECTORS = ("joints", "joint_speeds", "tcp_pose", "tcp_speed", "tcp_force")


class EpisodeError(ValueError):
    """A recording that is missing, damaged, of another kind, or larger than the limits."""


@dataclass(frozen=True, slots=True, eq=False)
class ArmPackages:
    """Packages of an arm's controller during a control step: a row for each package, oldest first, unchanged (base
    axes, not sensor axes)."""

    __repr__ = short_repr
    time: FloatArray  # (n,) when it was read, rig clock [s]
    stamp: FloatArray  # (n,) time on the controller's own clock [s]
    joints: FloatArray  # (n, 6) [rad]
    joint_speeds: FloatArray  # (n, 6) [rad/s]
    tcp_pose: FloatArray  # (n, 6) position and rotation vector [m, rad]
    tcp_speed: FloatArray  # (n, 6) [m/s, rad/s]
    tcp_force: FloatArray  # (n, 6) [N, N m]
    runtime_state: NDArray[np.int64]  # (n,) of the controller's program: 1 stopped, 2 playing, 4 paused
    safety_bits: NDArray[np.int64]  # (n,) safety_status_bits of the controller
    status: NDArray[np.int64]  # (n,) status by the driver: robot.ArmStatus
    lost: int = 0  # packages missing among these, or between these and those of the step before

    @classmethod
    def from_columns(cls, columns: Mapping[str, Any] | NDArray[np.void], lost: int = 0) -> Self:
        """From sequences with the names of the fields, or a structured array."""
        arrays: dict[str, Any] = {name: np.array(columns[name], np.float64) for name in ("time", "stamp")}
        arrays |= {name: np.array(columns[name], np.float64).reshape(-1, 6) for name in _VECTORS}
        arrays |= {name: np.array(columns[name], np.int64) for name in ("runtime_state", "safety_bits", "status")}
        return cls(**arrays, lost=lost)


class LazyRecords(Mapping[str, T], Generic[T]):
    """Parts of a recorded step by name: each is decoded at each access, and not stored.

    known: by name, a value that needs no decoding: exposure of a frame [s], number of lost packages of an arm. An
    access raises EpisodeError if the part cannot be decoded.
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

    __repr__ = short_repr
    index: int
    time: float  # of the observation, rig clock [s]
    frames: Mapping[str, TactileFrame]  # native, by sensor
    arms: Mapping[str, ArmState]
    action: Action | None = None  # as requested
    sent: Mapping[str, Pose | None] = field(default_factory=dict)  # as executed, by arm
    reward: float | None = None
    distance: float | None = None  # from the goal [m]
    info: Mapping[str, float] = field(default_factory=dict)  # e.g. body_height, contact_signal_upper, residual
    seconds: float = 0.0  # wall time of the step [s]
    packages: Mapping[str, ArmPackages] = field(default_factory=dict)  # by arm, if the rig file requests them
    body: NDArray[np.float32] | None = None  # (n, 3) particles of a simulated body, if requested; world [m]
    grippers: Mapping[str, GripperState] = field(default_factory=dict)
    sent_grippers: Mapping[str, GripperTarget | None] = field(default_factory=dict)  # as executed, by gripper

    @property
    def exposed(self) -> Mapping[str, float]:
        """Time of exposure of each frame [s]; decodes none."""
        if isinstance(self.frames, LazyRecords):
            return self.frames.known
        return {name: frame.time for name, frame in self.frames.items()}


@dataclass(frozen=True, slots=True, eq=False)
class EpisodeMeta:
    """Data of the whole episode."""

    __repr__ = short_repr
    rig: str
    task: str | None
    policy: str
    seed: int
    spec: RigSpec
    versions: Mapping[str, str]
    attachments: Mapping[str, bytes] = field(default_factory=dict)  # name -> content: rig.yaml, calibration bundles
    goal: float | tuple[float, ...] | None = None
    started: datetime | None = None  # with time zone
    wall_offset: int = 0  # wall clock minus the rig's clock, measured at the start [ns]


@dataclass(slots=True, eq=False)
class Episode:
    """The steps of an episode: in memory, or in its recording, from which each is read at each access."""

    __repr__ = short_repr
    meta: EpisodeMeta
    steps: Sequence[Step] = field(default_factory=list)
    complete: bool = True  # False: the recorder was killed; these are the steps written before
    dropped: int = 0  # steps that the recorder dropped


# Keys of `Step.info`: numbers of a step in addition to frames, states and actions.
# Before the name of an arm
ALIGNMENT = "alignment_"  # time from its state to the nearest package [s]
LIMITS_HIT = "limits_hit_"  # targets that were shortened or refused so far
PACKAGES_LOST = "packages_lost_"  # packages of its controller that are missing in this step
# Before the name of a sensor
PICTURES_LOST = "pictures_lost_"  # frames of its camera that never arrived, so far
PICTURES_DAMAGED = "pictures_damaged_"  # frames that could not be read, so far
PICTURES_REPEATED = "pictures_repeated_"  # frames with the same picture as the frame before, so far
CONTACT_SIGNAL = "contact_signal_"
STALE_REFERENCE = "stale_"  # 1: the reference is not valid any more
COLOUR_DRIFT = "drift_"  # change of the untouched gel's colour since the reference [-]
BACKGROUND_SLOPE = "background_"  # mean slope that corresponds to a drift of the light [degrees]
COLOURS_OUT_OF_RANGE = "beyond_"  # share of the picture whose colours are outside the calibrated slopes
VISIBLE_MARKERS = "kept_"  # share of the markers that were found
MAX_DEPTH = "deepest_"  # of the height of its gel [m]
MAX_SLOPE = "steepest_"  # of its gel [-]
MAX_FLOW = "flow_"  # longest displacement of a marker [m]
# By themselves
SETTLED = "settled"
TRAINING_DISTANCE = "training_distance"  # distance of the observation from the training range, over the limit
TRAINING_KNOWN = "training_range_known"  # 0: a learned policy without its training range
TACTILE_DISTANCE = "felt_distance"  # from the goal, estimated from tactile observations only [m]

ARM_KEYS = (ALIGNMENT, LIMITS_HIT, PACKAGES_LOST)
SENSOR_KEYS = (
    CONTACT_SIGNAL,
    MAX_DEPTH,
    MAX_SLOPE,
    MAX_FLOW,
    STALE_REFERENCE,
    COLOUR_DRIFT,
    BACKGROUND_SLOPE,
    COLOURS_OUT_OF_RANGE,
    VISIBLE_MARKERS,
    PICTURES_LOST,
    PICTURES_DAMAGED,
    PICTURES_REPEATED,
)

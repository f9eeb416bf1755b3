"""An episode in memory: what the recorder writes, the reader gives back, and the report shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from tacsim.interface import Action, ArmState, Pose, RigSpec, TactileFrame


class EpisodeError(ValueError):
    """A recording that is missing, damaged, of another kind, or beyond the limits of size."""


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


@dataclass(slots=True, eq=False)
class Episode:
    meta: EpisodeMeta
    steps: list[Step] = field(default_factory=list)
    complete: bool = True  # False: the recorder was killed; the steps flushed until then are here
    dropped: int = 0  # steps that the recorder had to drop

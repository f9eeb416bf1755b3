"""The parts of a rig as protocols: sensors, arms, grippers, clock; normalisers and policies."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from tacsim.interface.values import (
    Action,
    ArmState,
    GripperState,
    GripperTarget,
    Needs,
    Observation,
    Pose,
    SensorSpec,
    TactileFrame,
    TactileObservation,
)


class TactileSource(Protocol):
    """One tactile sensor: simulated, camera or recorded."""

    @property
    def spec(self) -> SensorSpec: ...
    def read(self, timeout: float) -> TactileFrame:
        """The newest frame. Raises TimeoutError after `timeout` [s], EndOfEpisode when a recording is over."""
        ...

    def close(self) -> None: ...


class Arm(Protocol):
    """One arm that carries a sensor: simulated, UR or recorded."""

    def state(self, at: float | None = None) -> ArmState:
        """The newest state; or that at a past moment of the rig's clock [s], such as the exposure of a picture."""
        ...

    def command(self, target: Pose | None) -> Pose | None:
        """Asks for `target` (None holds); returns what is really sent after the limits, None if nothing is executed."""
        ...

    def stop(self) -> None: ...
    def recover(self) -> None: ...
    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class GelReading:
    """The state of the gels, as reported to an arm."""

    exposed: float  # when the oldest picture of the rig was exposed, on its clock [s]
    depth: float = math.nan  # of the arm's own gels, the deepest; NaN: not measured [m]
    shear: float = math.nan  # of their surfaces, the largest; NaN: not measured [m]


class HardwareArm(Arm, Protocol):
    """An arm of a rig that goes by the wall clock. It keeps its limits, and holds when commands stop coming."""

    @property
    def latency(self) -> float:
        """How old a state is when it arrives [s]."""
        ...

    @property
    def alignment(self) -> float:
        """Of the last state at a past moment: time from that moment to the nearest package [s]."""
        ...

    def command(self, target: Pose | None, speed: float | None = None) -> Pose | None:
        """As `Arm.command`, at most at `speed` [m/s]. Raises ActionError (tacsim.limits) for what is out of reach, and
        DeviceError (robot.errors) for an arm that cannot follow."""
        ...

    def at_rest(self) -> bool:
        """True if neither the arm nor its target moves."""
        ...

    def arrived(self, target: Pose, *, within: float, turn: float) -> bool:
        """True if it is at rest `within` [m] and `turn` [rad] of the target."""
        ...

    def zero_wrench(self) -> None:
        """Zeroes its force sensor; it must be at rest and touch nothing."""
        ...

    def report_tactile(self, reading: GelReading | None) -> None:
        """Reports what its gels show: beyond limits.depth or limits.shear it stops. None suspends that until the next
        report."""
        ...

    def explain(self) -> str:
        """Its status in words."""
        ...


class Gripper(Protocol):
    """One parallel gripper: simulated, real or recorded."""

    @property
    def width_range(self) -> tuple[float, float]:
        """Least and greatest width [m]."""
        ...

    @property
    def force_range(self) -> tuple[float, float]:
        """Least and greatest force that it can be asked for [N]."""
        ...

    def state(self) -> GripperState:
        """The newest state."""
        ...

    def command(self, target: GripperTarget | None) -> GripperTarget | None:
        """Asks for `target` (None holds); returns what is really sent after its limits, None if nothing is executed."""
        ...

    def stop(self) -> None:
        """It stays where it is, and goes on holding what it holds."""
        ...

    def recover(self) -> None: ...
    def close(self) -> None: ...


class Clock(Protocol):
    """The rig's one clock: simulation advances physics in `tick`, hardware sleeps to its deadline."""

    @property
    def period(self) -> float: ...
    def now(self) -> float: ...
    def tick(self) -> None: ...


class Normaliser(Protocol):
    """Native frame of one sensor -> canonical observation."""

    @property
    def finds_height(self) -> bool:
        """Height and gradient are found in the picture of a frame that does not carry its surface."""
        ...

    @property
    def finds_flow(self) -> bool:
        """The same of the flow."""
        ...

    def take_reference(self, frame: TactileFrame) -> None:
        """Makes `frame`, taken without contact, the reference I0."""
        ...

    def __call__(self, frame: TactileFrame, now: float) -> TactileObservation: ...

    def diagnostics(self) -> Mapping[str, float]:
        """How trustworthy the last observation is, by keys of `Step.info`. Empty where a source knows its surface."""
        ...


@runtime_checkable
class Policy(Protocol):
    """Observation in, action out."""

    @property
    def needs(self) -> Needs: ...
    def reset(self) -> None: ...
    def __call__(self, observation: Observation) -> Action: ...

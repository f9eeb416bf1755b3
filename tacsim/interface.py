"""The contract between policies and rigs: observations, actions, and the parts of a rig.

A policy sees one :class:`Observation` and gives one :class:`Action`. Whether sensors, arms and clock behind them
are simulated, mock, real or replayed shows nowhere in this file. NumPy only.

Conventions (docs/architecture.md): SI units; right-handed frames; ``a_from_b`` maps coordinates in b to a.
``world``: z up, origin on the lower gel's rest surface. ``sensor``: origin at the centre of the gel's rest surface,
x along image columns, y along image rows, z out of the gel towards the object. Colours are RGB.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, fields
from textwrap import indent
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

# Types of arrays, for all packages
FloatArray = NDArray[np.float64]
Float32 = NDArray[np.float32]
Image = NDArray[np.uint8]  # (H, W, 3) RGB
Mask = NDArray[np.bool_]


def short_repr(self: Any) -> str:
    """`__repr__` of a dataclass: one line, or a line a field; of an array its shape, type and range."""
    own = getattr(self, "__dict__", None)  # with a LazyField as it was given: it is not made for its description
    values = {each.name: getattr(self, each.name) if own is None else own[each.name] for each in fields(self)}
    parts = [f"{name}={_describe_value(value)}" for name, value in values.items()]
    return _join_parts(f"{type(self).__name__}(", parts, ")")


def _join_parts(begin: str, parts: list[str], end: str) -> str:
    max_line = 80  # [characters]
    line = f"{begin}{', '.join(parts)}{end}"
    if len(line) <= max_line and "\n" not in line:
        return line
    return "\n".join([begin, *(indent(f"{part},", "    ") for part in parts), end])


def _describe_value(value: Any) -> str:
    max_entries = 8  # of an array or a sequence that is written out
    if isinstance(value, np.ndarray):
        return _describe_array(value, max_entries)
    if isinstance(value, Mapping):
        return _join_parts("{", [f"{key!r}: {_describe_value(each)}" for key, each in value.items()], "}")
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if isinstance(value, Sequence) and not isinstance(value, str) and len(value) > max_entries:
        return f"{type(value).__name__} of {len(value)}"
    if isinstance(value, np.generic):
        value = value.item()
    return "not made yet" if callable(value) else repr(value)


def _describe_array(array: NDArray[Any], max_entries: int) -> str:
    if array.ndim == 1 and len(array) <= max_entries and array.dtype.kind in "iuf":
        return f"[{', '.join(f'{value:.4g}' for value in array + 0.0)}]"  # + 0.0: no minus before a zero
    text = f"{array.dtype} {array.shape}"
    if array.dtype == np.bool_ and array.size:
        return f"{text} {100 * array.mean():.3g} % true"
    if array.dtype.kind not in "iuf" or not array.size:
        return text
    finite = array[np.isfinite(array)]
    scope = f" {finite.min():.4g} to {finite.max():.4g}" if finite.size else ""
    return f"{text}{scope}{f', {array.size - finite.size} not finite' if finite.size < array.size else ''}"


def _unit_quaternion() -> FloatArray:
    return np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A rigid transform ``a_from_b``: the origin and axes of b, written in a. Operations: :mod:`tacsim.pose`."""

    __repr__ = short_repr
    position: FloatArray = field(default_factory=lambda: np.zeros(3))  # (3,) [m]
    quaternion: FloatArray = field(default_factory=_unit_quaternion)  # (4,) unit, x y z w

    def __post_init__(self) -> None:
        position = np.array(self.position, dtype=np.float64)
        quaternion = np.array(self.quaternion, dtype=np.float64)
        if position.shape != (3,) or not all(map(math.isfinite, position.tolist())):
            raise ValueError(f"Pose.position must be 3 finite numbers [m], got {self.position!r}")
        if quaternion.shape != (4,) or not all(map(math.isfinite, quaternion.tolist())):
            raise ValueError(f"Pose.quaternion must be 4 finite numbers (x, y, z, w), got {self.quaternion!r}")
        norm = math.sqrt(quaternion.dot(quaternion))
        if abs(norm - 1.0) > 1e-3:
            raise ValueError(f"Pose.quaternion must have unit length, got length {norm:.6g}")
        if abs(norm - 1.0) > 1e-15:  # else keep the bits: a recorded pose reads back unchanged
            quaternion = quaternion / norm
        position.flags.writeable = False
        quaternion.flags.writeable = False
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "quaternion", quaternion)


FieldValue = TypeVar("FieldValue")


class LazyField(Generic[FieldValue]):
    """A field of a dataclass, given as it is or as a function that makes it, called when the field is first looked at:
    no picture is rendered for who looks at heights and forces only."""

    def __init__(self, *default: FieldValue) -> None:
        self._default = default

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, instance: object | None, owner: type | None = None) -> FieldValue:
        if instance is None:  # `dataclass` asks for the default so, and takes this error for none
            if not self._default:
                raise AttributeError(self._name)
            return self._default[0]
        value: Any = instance.__dict__[self._name]
        if callable(value):
            value = instance.__dict__[self._name] = value()
        return value  # type: ignore[no-any-return]

    def __set__(self, instance: object, value: FieldValue | Callable[[], FieldValue]) -> None:
        instance.__dict__[self._name] = value


class LazyFields:
    """A dataclass whose fields `LazyField` are made before it is copied or sent to another process."""

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self.__dict__}


@dataclass(frozen=True, eq=False)
class SurfaceMap(LazyFields):
    """The gel surface on the canonical grid, from a source that knows it by itself (the simulator)."""

    __repr__ = short_repr
    height: NDArray[np.float32]  # (h, w) displacement into the gel, positive where pressed [m]
    gradient: LazyField[NDArray[np.float32]] = LazyField()  # (h, w, 2) (d height/dx, d height/dy) [-]
    flow: NDArray[np.float32] | None = None  # (m, n, 2) in-plane displacement at the marker lattice, sensor x, y [m]


@dataclass(frozen=True, eq=False)
class TactileFrame(LazyFields):
    """What any source delivers: the picture as the camera gave it."""

    __repr__ = short_repr
    image: LazyField[NDArray[np.uint8]] = LazyField()  # (H, W, 3) RGB
    _: KW_ONLY
    time: float  # exposure time on the rig's monotonic clock [s]
    index: int  # frame counter; a gap = dropped frames
    surface: SurfaceMap | None = None  # only from sources that know it
    stats: Mapping[str, float] = field(default_factory=dict)  # of the simulation for this frame: residual ...


@dataclass(frozen=True, eq=False)
class TactileObservation(LazyFields):
    """Canonical touch: what a policy sees, the same for every source. What a sensor does not deliver is None."""

    __repr__ = short_repr
    # (H, W, 3) clip(128 + 128 (I - I0) / mean(I0)) over the canonical area
    image: LazyField[NDArray[np.uint8]] = LazyField()
    _: KW_ONLY
    gradient: LazyField[NDArray[np.float32] | None] = LazyField()  # (h, w, 2) surface slope [-]
    height: NDArray[np.float32] | None  # (h, w) into the gel, 0 at the contact-free rim [m]
    contact: NDArray[np.bool_]  # (h, w)
    valid: NDArray[np.bool_]  # (h, w) False where the sensor has no gel or no pixels
    flow: NDArray[np.float32] | None  # (m, n, 2) tactile flow [m]
    time: float  # exposure time [s]
    age: float  # time of the observation minus time of exposure [s]
    # (H, W, 3) RGB as the camera gave it: not canonical, so what learns from it learns one sensor's light, too
    picture: LazyField[NDArray[np.uint8] | None] = LazyField(None)


@dataclass(frozen=True, slots=True, eq=False)
class ArmState:
    """One controller package of an arm. ``pose``, ``twist`` and ``wrench`` speak of one frame: the sensor that the arm
    carries (the tool, if it carries none)."""

    __repr__ = short_repr
    pose: Pose  # world_from_sensor
    twist: FloatArray  # (6,) linear then angular velocity of the sensor, world axes [m/s, rad/s]
    wrench: FloatArray  # (6,) what the object does to the sensor, about its origin, sensor axes [N, N m]
    joints: FloatArray | None  # (n,) joint angles [rad]
    time: float  # [s]


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    __repr__ = short_repr
    tactile: Mapping[str, TactileObservation]  # by sensor name
    arms: Mapping[str, ArmState]  # by arm name
    time: float  # [s]


@dataclass(frozen=True, slots=True, eq=False)
class Action:
    """Desired world_from_sensor (not the TCP) at the end of the control period, by arm name; None or absent: hold."""

    __repr__ = short_repr
    tool: Mapping[str, Pose | None] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What only a simulation knows. Tasks may use it, policies never see it."""

    __repr__ = short_repr
    height: float  # z-extent of the body, particle radius included [m]
    position: FloatArray  # (3,) centre of mass, world [m]
    points: NDArray[np.float32]  # (n, 3) body particles, world [m]
    poses: Mapping[str, Pose]  # world_from_sensor


@dataclass(frozen=True, slots=True)
class SensorSpec:
    """What one tactile source delivers."""

    image_shape: tuple[int, int]  # rows, columns of the native frame
    height: bool  # gradient and height are delivered
    flow: bool  # tactile flow is delivered
    arm: str | None  # the arm that carries it


@dataclass(frozen=True, slots=True)
class RigSpec:
    """What a rig delivers."""

    sensors: Mapping[str, SensorSpec]
    arms: tuple[str, ...]
    truth: bool
    period: float  # control period [s]


@dataclass(frozen=True, slots=True)
class Needs:
    """What a task or policy asks of a rig."""

    sensors: frozenset[str] = frozenset()
    arms: frozenset[str] = frozenset()
    height: bool = False
    flow: bool = False
    truth: bool = False

    def missing(self, spec: RigSpec) -> list[str]:
        """What `spec` does not deliver, each as a phrase for a person; empty when all is there."""
        missing = [f"sensor '{name}'" for name in sorted(self.sensors - set(spec.sensors))]
        missing += [f"arm '{name}'" for name in sorted(self.arms - set(spec.arms))]
        for name, sensor in spec.sensors.items():
            if self.height and not sensor.height:
                missing.append(f"surface height of sensor '{name}' (it has no photometric calibration)")
            if self.flow and not sensor.flow:
                missing.append(f"tactile flow of sensor '{name}' (it has no markers)")
        if self.truth and not spec.truth:
            missing.append("ground truth of the body (only simulation has it)")
        return missing


class IncompatibleRig(ValueError):
    """A task or policy needs what the rig does not deliver."""


class EndOfEpisode(Exception):
    """A replayed source has no further frame."""


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

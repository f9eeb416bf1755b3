"""The contract between policies and rigs: observations, actions, and what rigs deliver.

A policy sees one :class:`Observation` and gives one :class:`Action`. Whether sensors, arms and clock behind them
are simulated, mock, real or replayed shows nowhere here. NumPy only.

Conventions (docs/architecture.md): SI units; right-handed frames; ``a_from_b`` maps coordinates in b to a.
``world``: z up, origin on the lower gel's rest surface. ``sensor``: origin at the centre of the gel's rest surface,
x along image columns, y along image rows, z out of the gel towards the object. Colours are RGB.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field

import numpy as np
from numpy.typing import NDArray

from tacsim.interface.description import short_repr
from tacsim.interface.lazy_field import LazyField, LazyFields

# Types of arrays, for all packages
FloatArray = NDArray[np.float64]
Float32 = NDArray[np.float32]
Image = NDArray[np.uint8]  # (H, W, 3) RGB
Mask = NDArray[np.bool_]


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
    """One controller package of an arm. ``pose``, ``twist`` and ``wrench`` belong to one frame: the sensor that the arm
    carries (its gripper, or the tool, if it carries none)."""

    __repr__ = short_repr
    pose: Pose  # world_from_sensor
    twist: FloatArray  # (6,) linear then angular velocity of the sensor, world axes [m/s, rad/s]
    wrench: FloatArray  # (6,) what the object does to the sensor, about its origin, sensor axes [N, N m]
    joints: FloatArray | None  # (n,) joint angles [rad]
    time: float  # [s]


@dataclass(frozen=True, slots=True)
class GripperState:
    """A parallel gripper."""

    width: float  # between the surfaces that grip, untouched gels or bare fingers [m]
    force: float | None  # of each finger on what it grips; None: not measured [N]
    time: float  # [s]


@dataclass(frozen=True, eq=False)
class View(LazyFields):
    """What a camera sees that looks at the scene, not through a gel."""

    __repr__ = short_repr
    image: LazyField[NDArray[np.uint8]] = LazyField()  # (H, W, 3) RGB
    _: KW_ONLY
    time: float  # exposure time [s]


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    __repr__ = short_repr
    tactile: Mapping[str, TactileObservation]  # by sensor name
    arms: Mapping[str, ArmState]  # by arm name
    time: float  # [s]
    grippers: Mapping[str, GripperState] = field(default_factory=dict)  # by gripper name
    views: Mapping[str, View] = field(default_factory=dict)  # by name of the camera; not recorded


@dataclass(frozen=True, slots=True)
class GripperTarget:
    """What a parallel gripper does: it moves to a width and stops there, or where it grips with a force. To grip with
    that force, ask for a width below that of the object, such as 0."""

    width: float  # at the end of the control period, as in GripperState [m]
    force: float  # largest force of each finger [N]


@dataclass(frozen=True, slots=True, eq=False)
class Action:
    """What arms and grippers do in a control period, by name; None or absent: it holds."""

    __repr__ = short_repr
    # Desired world_from_sensor (not the TCP) at the end of the period; of an arm with a gripper: world_from_gripper
    tool: Mapping[str, Pose | None] = field(default_factory=dict)
    grippers: Mapping[str, GripperTarget | None] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What only a simulation knows. Tasks may use it, policies never see it. The body is the clay, or the first of the
    rigid objects."""

    __repr__ = short_repr
    height: float  # z-extent of the body, particle radius included [m]
    position: FloatArray  # (3,) centre of mass, world [m]
    points: NDArray[np.float32]  # (n, 3) its particles, or points of its surface, world [m]
    poses: Mapping[str, Pose]  # world_from_sensor
    objects: Mapping[str, Pose] = field(default_factory=dict)  # world_from_object of rigid objects, by name
    forces: Mapping[str, float] = field(default_factory=dict)  # normal force on a sensor that touches one, by name [N]


@dataclass(frozen=True, slots=True)
class SensorSpec:
    """What one tactile source delivers."""

    image_shape: tuple[int, int]  # rows, columns of the native frame
    height: bool  # gradient and height are delivered
    flow: bool  # tactile flow is delivered
    arm: str | None  # the arm that carries it
    gripper: str | None = None  # the gripper that carries it; its `arm` is then None


@dataclass(frozen=True, slots=True)
class RigSpec:
    """What a rig delivers."""

    sensors: Mapping[str, SensorSpec]
    arms: tuple[str, ...]
    truth: bool
    period: float  # control period [s]
    grippers: tuple[str, ...] = ()
    views: tuple[str, ...] = ()  # cameras that look at the scene


@dataclass(frozen=True, slots=True)
class Needs:
    """What a task or policy asks of a rig."""

    sensors: frozenset[str] = frozenset()
    arms: frozenset[str] = frozenset()
    height: bool = False
    flow: bool = False
    truth: bool = False
    grippers: frozenset[str] = frozenset()
    views: frozenset[str] = frozenset()

    def missing(self, spec: RigSpec) -> list[str]:
        """What `spec` does not deliver, each as a phrase for a person; empty when all is there."""
        missing = [f"sensor '{name}'" for name in sorted(self.sensors - set(spec.sensors))]
        missing += [f"arm '{name}'" for name in sorted(self.arms - set(spec.arms))]
        missing += [f"gripper '{name}'" for name in sorted(self.grippers - set(spec.grippers))]
        missing += [f"camera '{name}' that looks at the scene" for name in sorted(self.views - set(spec.views))]
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

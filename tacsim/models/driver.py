"""Drivers of sensors, arms and grippers: what a rig asks of one, and how the installed ones are found.

A driver is a class that an installed distribution names in its entry point group `tacsim.drivers`, as "sensor.NAME",
"arm.NAME" or "gripper.NAME"; ours are found in the same way. NAME is the `driver:` of a rig file, and that of the
class's `config_class`. Its module is imported whenever a rig file is read, so it imports what is heavy (a camera's
SDK, OpenCV) in `open`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from typing import Any, ClassVar, Generic, Literal, NamedTuple, Protocol, TypeVar, cast, get_args

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import HardwareArm, Normaliser, Pose, SensorSpec, TactileSource, Truth
from tacsim.models.hardware import ArmConfig, GripperConfig, SensorConfig
from tacsim.models.sensor import CanonicalGrid

GROUP = "tacsim.drivers"
OWN = "tacsim"  # the distribution that brings the shipped drivers
INSTALL = "python -m pip install -e . --no-deps --no-build-isolation"  # in the checkout
LATENCY_ADVICE = (
    "so how deep a gel is pressed before the arm brakes cannot be computed (state the longest time in seconds)"
)

SensorC = TypeVar("SensorC", bound=SensorConfig)
ArmC = TypeVar("ArmC", bound=ArmConfig)
GripperC = TypeVar("GripperC", bound=GripperConfig)
State = Literal["ok", "warn", "fail"]
ClockName = Literal["sim", "mujoco", "wall", "replay"]


@dataclass(frozen=True, slots=True)
class Check:
    """One finding of `tacsim doctor`."""

    name: str
    state: State
    found: str
    advice: str = ""  # what to do next; empty when all is well


class Companion(Protocol):
    """What runs with a rig's mocks, such as the simulation that feeds them. Made of the rig's configuration, entered
    as a context manager; its `close` ends all of it."""

    @property
    def start_poses(self) -> Mapping[str, Pose]:
        """world_from_sensor where an episode begins, of the mock arms, by name."""
        ...

    @property
    def is_simulated(self) -> bool:
        """Gels are simulated here, which must follow the arms."""
        ...

    @property
    def picture_sources(self) -> Collection[str]:
        """The sensors whose pictures it makes, by name."""
        ...

    def sensor(self, name: str, spec: SensorSpec) -> TactileSource:
        """A sensor that is simulated here, without a camera. Its `close` does nothing."""
        ...

    def place(self) -> None:
        """Puts a fresh body in its place, as a person does at a real rig."""
        ...

    def step(self, pause: float = 0.0) -> Mapping[str, int]:
        """Lets what is simulated follow the arms once; `pause` [s] between forces and pictures. Returns the number of
        the newest picture of each of `picture_sources`."""
        ...

    def run_free(self) -> None:
        """It follows the arms by itself from now on."""
        ...

    def wait_for_fresh_step(self) -> None:
        """While it runs freely: waits for a whole step that begins from now on."""
        ...

    def truth(self) -> Truth | None: ...
    def diagnostics(self) -> Mapping[str, float]: ...
    def close(self) -> None: ...

    @staticmethod
    def has_simulated_body(config: Any) -> bool:
        """Whether the companion of a rig (RigConfig) has a simulated body."""
        ...


class PackageLog(Protocol):
    """Every package of an arm's controller, drained step by step."""

    def take(self) -> Any:
        """Those since the last call, as tacsim.record.episode.ArmPackages."""
        ...


class SensorPart(ABC, Generic[SensorC]):
    """A sensor as its rig file describes it; making one opens nothing.

    grid: of the canonical observation. gel_size: x, y of the gel in the rig's scene [m]; None without a scene.
    """

    config_class: ClassVar[type[SensorConfig]]
    clocks: ClassVar[tuple[ClockName, ...]]  # that a rig with such a sensor may go by

    def __init__(
        self, config: SensorC, name: str, grid: CanonicalGrid, gel_size: tuple[float, float] | None = None
    ) -> None:
        self.config, self.name, self.grid, self.gel_size = config, name, grid, gel_size

    def require(self) -> None:
        """Raises ValueError, in words, for a configuration that cannot be opened. Opens nothing."""
        return

    @abstractmethod
    def normaliser(self, untouched: NDArray[np.uint8] | None = None) -> Normaliser:
        """What makes canonical observations of its frames, live or recorded.

        untouched: the native picture without contact (rows, columns, 3) of a recording. Raises ValueError, and
        calibration.errors.CalibrationError.
        """


class SensorDriver(SensorPart[SensorC]):
    """A sensor of a rig that goes by the wall clock. All that is abstract must be stated, or the driver is refused."""

    clocks: ClassVar[tuple[ClockName, ...]] = ("wall",)

    @property
    def companion(self) -> str | None:
        """ "module:class" of the Companion that its mock needs; None for a device that runs by itself."""
        return None

    @abstractmethod
    def spec(self, normaliser: Normaliser) -> SensorSpec:
        """What it delivers once its frames are normalised so."""

    @abstractmethod
    def open(self, spec: SensorSpec, companion: Companion | None) -> TactileSource:
        """Connects. Raises DeviceError (robot.errors) for what cannot be opened."""

    @abstractmethod
    def sample_rate(self) -> float:
        """New frames a second [Hz]."""

    @abstractmethod
    def worst_latency(self) -> float:
        """Longest time from a touch to the frame that shows it, the time between two frames included [s]."""

    @abstractmethod
    def checks(self) -> Iterable[Check]:
        """What `tacsim doctor` says of it. Connects, looks, and closes; raises nothing."""

    def diagnostics(self, source: TactileSource) -> Mapping[str, float]:
        """Numbers of an open one that are recorded with each step, by key (tacsim.record.episode)."""
        return {}


class ArmPart(Generic[ArmC]):
    """An arm as its rig file describes it; making one opens nothing. keep_out: least distances of its sensor to those
    of other arms, by their names [m]."""

    config_class: ClassVar[type[ArmConfig]]
    clocks: ClassVar[tuple[ClockName, ...]]

    def __init__(self, config: ArmC, name: str, keep_out: Mapping[str, float] | None = None) -> None:
        self.config, self.name, self.keep_out = config, name, dict(keep_out or {})

    def require(self) -> None:
        """Raises ValueError, in words, for a configuration that cannot be opened. Opens nothing."""
        return


class ArmExamination(NamedTuple):
    checks: list[Check]
    sensor_pose: Pose | None  # world_from_sensor as it stands now; None: not known


class ArmDriver(ArmPart[ArmC], ABC):
    """An arm of a rig that goes by the wall clock. All that is abstract must be stated, or the driver is refused. Its
    configuration has `limits: ArmLimits`, which the arm that it opens keeps."""

    clocks: ClassVar[tuple[ClockName, ...]] = ("wall",)
    # The arm keeps its `keep_out` from arms of the same driver. Otherwise a rig file that asks for it is refused.
    keeps_distances: ClassVar[bool] = False

    @property
    def companion(self) -> str | None:
        """As of a SensorDriver."""
        return None

    @abstractmethod
    def open(self) -> HardwareArm:
        """Connects; moves nothing. Raises DeviceError (robot.errors) for what cannot be opened."""

    @abstractmethod
    def worst_latency(self) -> float:
        """Longest time from a command to hold to the moment when the arm brakes [s]."""

    @abstractmethod
    def examine(self, start: Pose | None, file: str) -> ArmExamination:
        """What `tacsim doctor` says of it: connects, looks, closes, commands nothing. Raises nothing.

        start: world_from_sensor where an episode begins. file: the rig file, for commands to be typed next.
        """

    def package_log(self, arm: HardwareArm) -> PackageLog | None:
        """What records every package of the controller of an open one, where `config.records_packages`."""
        return None


class GripperPart(Generic[GripperC]):
    """A parallel gripper as its rig file describes it; making one opens nothing."""

    config_class: ClassVar[type[GripperConfig]]
    clocks: ClassVar[tuple[ClockName, ...]]

    def __init__(self, config: GripperC, name: str) -> None:
        self.config, self.name = config, name


AnyPart = type[SensorPart[Any]] | type[ArmPart[Any]] | type[GripperPart[Any]]
# The class of all of a kind, and that of hardware; hardware of grippers is not supported yet
BASE_CLASSES: dict[str, tuple[type, type | None]] = {
    "sensor": (SensorPart, SensorDriver),
    "arm": (ArmPart, ArmDriver),
    "gripper": (GripperPart, None),
}


class DriversMissing(ValueError):
    """The shipped drivers are not registered: the installation is older than its code."""

    def __init__(self) -> None:
        super().__init__(
            f"the drivers of tacsim are not registered: this installation is older than its code. In the checkout, run "
            f"`{INSTALL}`; an installed tacsim: `python -m pip install --force-reinstall --no-deps tacsim`"
        )


@dataclass(frozen=True, slots=True)
class Drivers:
    """The installed drivers, by kind ("sensor", "arm", "gripper") and name, and why others are refused."""

    usable: Mapping[str, dict[str, AnyPart]] = field(default_factory=lambda: {kind: {} for kind in BASE_CLASSES})
    refused: Mapping[str, dict[str, str]] = field(default_factory=lambda: {kind: {} for kind in BASE_CLASSES})


@cache
def installed_drivers() -> Drivers:
    """Looked up once in a process. Raises DriversMissing."""
    found, homes = Drivers(), dict[tuple[str, str], str]()
    for entry in sorted(metadata.entry_points(group=GROUP), key=lambda each: each.name):
        kind, _, name = entry.name.partition(".")
        home = "an unknown distribution" if entry.dist is None else entry.dist.name
        if kind not in BASE_CLASSES:
            kinds = ", ".join(f"'{each}.{name}'" for each in BASE_CLASSES)
            why = f"{home} calls it '{entry.name}' in the group {GROUP}; call it one of {kinds}"
            for each in BASE_CLASSES:
                found.refused[each][name] = why
            continue
        if (kind, name) in homes:
            why = f"{home} and {homes[kind, name]} both bring one; uninstall one of them"
            found.usable[kind].pop(name, None)
            found.refused[kind][name] = why
            continue
        homes[kind, name] = home
        driver, why = _load(entry, kind, name, is_own=home == OWN)
        if driver is None:
            found.refused[kind][name] = f"the one of {home} ({entry.value}) {why}"
        else:
            found.usable[kind][name] = driver
    if OWN not in homes.values():
        raise DriversMissing
    return found


def _load(entry: metadata.EntryPoint, kind: str, name: str, *, is_own: bool) -> tuple[AnyPart | None, str]:
    """The class of an entry point; else None, and why it is refused."""
    part, driver = BASE_CLASSES[kind]
    try:
        found = entry.load()
    except Exception as failure:  # whatever a distribution of another author raises: other drivers still work
        return None, f"cannot be loaded: {type(failure).__name__}: {failure}"
    if not (isinstance(found, type) and issubclass(found, part)):
        return None, f"is no class that derives from tacsim.{(driver or part).__name__}"
    clocks = getattr(found, "clocks", ())
    if clocks != ("wall",) and not is_own:
        return None, f"goes by the clocks {clocks}; simulations and replays have drivers of tacsim alone, so ('wall',)"
    if "wall" in clocks and driver is None:
        return None, f"goes by the wall clock, and tacsim opens no {kind} of hardware yet"
    if "wall" in clocks and driver is not None and not issubclass(found, driver):
        return None, f"goes by the wall clock and does not derive from tacsim.{driver.__name__}"
    missing = sorted(getattr(found, "__abstractmethods__", ()))
    if missing:
        words = f"does not state {', '.join(missing)}"
        return None, f"{words}, {LATENCY_ADVICE}" if "worst_latency" in missing else words
    usable = cast(AnyPart, found)  # it derives from one of the two
    config = getattr(usable, "config_class", None)
    if config is None or get_args(config.model_fields["driver"].annotation) != (name,):
        return None, f'has no config_class with `driver: Literal["{name}"]`'
    return usable, ""


def refused_driver(parts: str, name: str) -> str | None:
    """Why an installed driver of that name is refused; None for one that is not. parts: "sensors", "arms" or
    "grippers"."""
    return installed_drivers().refused.get(parts.removesuffix("s"), {}).get(name)


def sensor_part(
    config: SensorConfig, name: str, grid: CanonicalGrid, gel_size: tuple[float, float] | None = None
) -> SensorPart[Any]:
    """The driver of one sensor of a rig. Raises ValueError for one that is not installed."""
    made: SensorPart[Any] = _class_of(config, "sensor", name)(config, name, grid, gel_size)
    return made


def arm_part(config: ArmConfig, name: str, keep_out: Mapping[str, float] | None = None) -> ArmPart[Any]:
    """The driver of one arm of a rig. Raises ValueError for one that is not installed."""
    made: ArmPart[Any] = _class_of(config, "arm", name)(config, name, keep_out)
    return made


def gripper_part(config: GripperConfig, name: str) -> GripperPart[Any]:
    """The driver of one gripper of a rig. Raises ValueError for one that is not installed."""
    made: GripperPart[Any] = _class_of(config, "gripper", name)(config, name)
    return made


def _class_of(config: SensorConfig | ArmConfig | GripperConfig, kind: str, name: str) -> Any:
    drivers = installed_drivers()
    found = drivers.usable[kind].get(config.driver)
    if found is None:
        why = refused_driver(kind, config.driver)
        reason = f"is refused: {why}" if why else f"is not installed; there are {', '.join(drivers.usable[kind])}"
        raise ValueError(f"{kind}s.{name}: the driver '{config.driver}' {reason}")
    return found

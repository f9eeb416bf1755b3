"""Rigs of hardware: arms and sensors, real or mock, simulated sensors on them, and their clocks (the wall clock, and
lock step for mock rigs; both count time.monotonic())."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from typing import Any, Protocol, cast

import numpy as np

from robot.errors import DeviceError, SafetyViolation
from robot.rig.commanded_arm import CommandedArm, wait_for_arrival
from robot.rig.parts import arm_drivers, companion_class, sensor_drivers, start_companion
from robot.rig.reset import ForceTouch, HardwareReset, PictureTouch, TouchSensing
from tacsim.control import GelMonitor, load_controller
from tacsim.interface import Normaliser, Pose, RigSpec, SensorSpec, TactileFrame, TactileSource
from tacsim.models.driver import ArmDriver, Companion, SensorDriver
from tacsim.models.hardware import CameraSensorConfig, parts_of
from tacsim.models.limits import ArmLimits
from tacsim.models.rig import RigConfig
from tacsim.record.episode import ALIGNMENT, LIMITS_HIT
from tacsim.rig import Rig

FORCE_DELAY = 10e-3  # from setting a force of a mock controller until its packages contain it [s]
CONFIRMATION_QUESTION = "Is the body in its place in front of the sensor, and is everyone out of reach of the arm?"


class _MonotonicClock:
    def __init__(self, period: float) -> None:
        self.period = period  # [s]

    def now(self) -> float:
        return time.monotonic()


class WallClock(_MonotonicClock):
    """Ticks at a fixed rate. Missed periods are skipped and counted.

    wait_for_fresh_step: waits until the simulation of a mock cell, if there is one, has followed the arms.
    real_time: images and forces arrive in real time; a simulation may be slower.
    """

    def __init__(
        self, period: float, wait_for_fresh_step: Callable[[], None] | None = None, *, real_time: bool = True
    ) -> None:
        super().__init__(period)
        self._wait_for_fresh_step, self.real_time = wait_for_fresh_step, real_time
        self._deadline: float | None = None
        self.periods: list[float] = []  # of the last ticks [s]
        self.late = 0
        self._last: float | None = None

    def tick(self) -> None:
        now = time.monotonic()
        if self._deadline is None or now > self._deadline + self.period:
            self.late += self._deadline is not None
            self._deadline = now
        self._deadline += self.period
        time.sleep(max(0.0, self._deadline - time.monotonic()))
        beat = time.monotonic()
        if self._last is not None:
            self.periods = [*self.periods[-9999:], beat - self._last]
        self._last = beat

    def wait_for_data(self) -> None:
        """Waits until packages and images of the present poses have arrived: one period, at least 0.1 s."""
        if self._wait_for_fresh_step is not None:
            self._wait_for_fresh_step()
        time.sleep(max(0.1, self.period))

    def restart(self) -> None:
        """The next tick ends one period after its call."""
        self._deadline = self._last = None

    def diagnostics(self) -> dict[str, float]:
        if not self.periods:
            return {}
        median, p99, longest = np.percentile(self.periods, [50, 99, 100])
        return {"period_median": median, "period_p99": p99, "period_max": longest, "periods_late": float(self.late)}


class NumberedSource(Protocol):
    """A sensor whose images carry the numbers that a companion assigns."""

    def wait_for(self, image_number: int, timeout: float) -> TactileFrame: ...


class LockStep(_MonotonicClock):
    """A period ends when the arms rest at their targets and the cell has rendered the images of that pose."""

    real_time = False

    def __init__(
        self,
        period: float,
        arms: Mapping[str, CommandedArm],
        sensors: Mapping[str, TactileSource],
        companion: Companion,
        late_images: int = 0,
    ) -> None:
        """sensors: those whose images the companion renders; each is a NumberedSource. late_images: how many motions of
        the companion the latest of them is behind."""
        super().__init__(period)
        self._late_images = late_images
        self._arms, self._companion = arms, companion
        self._sensors = {name: cast(NumberedSource, sensor) for name, sensor in sensors.items()}

    def tick(self) -> None:
        """Raises DeviceError if an arm does not arrive or is stopped, the cell fails, or an image does not arrive."""
        arrival_timeout = 10.0  # longest motion of a control period in lock step [s]
        wait_for_arrival(self._arms, arrival_timeout)
        self._step_cell()

    def wait_for_data(self) -> None:
        """Moves the cell to the poses of the arms, and waits until forces and images of them have arrived over the
        wire, also images that are late."""
        for _ in range(1 + self._late_images):
            self._step_cell()

    def _step_cell(self) -> None:
        for name, number in self._companion.step(pause=FORCE_DELAY).items():
            self._sensors[name].wait_for(number, timeout=5.0)

    def restart(self) -> None:
        """Does nothing: nothing runs between ticks."""

    def diagnostics(self) -> dict[str, float]:
        return {}


Confirm = Callable[[str], bool]
SensorDrivers = Mapping[str, SensorDriver[Any]]
ArmDrivers = Mapping[str, ArmDriver[Any]]


def open_hardware(
    config: RigConfig,
    confirm: Confirm | None,
    *,
    dry_run: bool = False,
    check: Callable[[RigSpec], None] | None = None,
    report: Callable[[str], None] = lambda words: None,
) -> Rig:
    """Opens a rig of hardware: starts the mocks of its file and connects. Nothing moves.

    confirm: asks the operator before an arm approaches the body; not needed if all arms are mocks.
    dry_run: connects, observes and records, but sends no motion, neither in a reset nor in a step.
    check: gets the specification of the rig before any device is opened; raises to refuse it.
    report: gets a short text about what the arms are doing in a reset, repeatedly.

    Raises DeviceError for a device that cannot be opened, calibration.errors.CalibrationError for a calibration,
    ValueError for a rig with contradicting settings.
    """
    is_real = any(arm.is_real for arm in config.arms.values())
    # first: a wrong calibration, host or limit, or a missing setting, is reported before any device is connected
    sensor_kinds, arm_kinds = sensor_drivers(config), arm_drivers(config)
    normalisers = {name: driver.normaliser() for name, driver in sensor_kinds.items()}
    spec = _make_spec(config, sensor_kinds, normalisers)
    _make_gel_monitor(config, spec.sensors, {})
    _require_safe_approach_speed(config, sensor_kinds, arm_kinds)
    _require_keep_outs(config, arm_kinds)
    for driver in arm_kinds.values():
        driver.require()
    if check is not None:
        check(spec)
    with ExitStack() as stack:
        companion = start_companion(config)
        if companion is not None:
            stack.callback(companion.close)
        sensors = {
            name: stack.enter_context(closing(driver.open(spec.sensors[name], companion)))
            for name, driver in sensor_kinds.items()
        }
        arms = {
            name: stack.enter_context(closing(CommandedArm(driver.open(), dry_run=dry_run)))
            for name, driver in arm_kinds.items()
        }
        clock = _make_clock(config, companion, arms, sensors, is_real=is_real)
        monitor = _make_gel_monitor(config, spec.sensors, arms)
        task = config.task
        reset = HardwareReset(
            arms={} if dry_run else arms,
            sensors=sensors,
            start=_start_poses(config, companion),
            clock=clock,
            config=config.start,
            touch_sensing=None if dry_run else _make_touch_sensing(config, arms, sensors, normalisers, monitor),
            confirm=_make_confirmation(config, companion, confirm, is_real=is_real and not dry_run),
            placement=0.0 if task is None else task.placement,
            report=report,
        )

        packages = arm_kinds if config.record.arm_packages else {}
        logs = {
            name: log for name, driver in packages.items() if (log := driver.package_log(arms[name].driver)) is not None
        }
        rig = Rig(
            name=config.name,
            sensors=sensors,
            arms=arms,
            clock=clock,
            normalisers=normalisers,
            reset=reset,
            truth=companion.truth if companion is not None and spec.truth else None,
            diagnostics=lambda: _collect_diagnostics(companion, clock, arms, sensor_kinds, sensors),
            packages=lambda: {name: log.take() for name, log in logs.items()},
            on_close=None if companion is None else companion.close,
            on_tactile=monitor,
            load_control=load_controller(config.task),
        )
        stack.pop_all()
        return rig


def hardware_spec(config: RigConfig) -> RigSpec:
    """The specification of a rig of hardware; no device is opened. Raises CalibrationError, ValueError."""
    drivers = sensor_drivers(config)
    return _make_spec(config, drivers, {name: driver.normaliser() for name, driver in drivers.items()})


def _make_spec(config: RigConfig, drivers: SensorDrivers, normalisers: Mapping[str, Normaliser]) -> RigSpec:
    sensors = {name: driver.spec(normalisers[name]) for name, driver in drivers.items()}
    companion = companion_class(config)
    truth = companion is not None and companion.has_simulated_body(config)
    return RigSpec(sensors, tuple(config.arms), truth, config.period)


def _make_clock(
    config: RigConfig,
    companion: Companion | None,
    arms: Mapping[str, CommandedArm],
    sensors: Mapping[str, TactileSource],
    *,
    is_real: bool,
) -> LockStep | WallClock:
    """A lock-step clock if all devices can wait (no real arm, simulated gels), otherwise the wall clock."""
    if companion is None or not companion.is_simulated:
        return WallClock(config.period)
    if config.lock_step and not is_real:
        cameras = parts_of(config.sensors, CameraSensorConfig).values()
        late = max((camera.mock.delay for camera in cameras if camera.mock is not None), default=0)
        rendered = {name: sensors[name] for name in companion.picture_sources}
        return LockStep(config.period, arms, rendered, companion, late)
    companion.run_free()
    return WallClock(config.period, companion.wait_for_fresh_step, real_time=config.contact == "hertz")


def _collect_diagnostics(
    companion: Companion | None,
    clock: LockStep | WallClock,
    arms: Mapping[str, CommandedArm],
    drivers: SensorDrivers,
    sensors: Mapping[str, TactileSource],
) -> Mapping[str, float]:
    values = {**({} if companion is None else companion.diagnostics()), **clock.diagnostics()}
    for name, arm in arms.items():
        values |= {f"{ALIGNMENT}{name}": arm.driver.alignment, f"{LIMITS_HIT}{name}": float(arm.limits_hit)}
    for name, driver in drivers.items():
        values |= driver.diagnostics(sensors[name])
    return values


def _start_poses(config: RigConfig, companion: Companion | None) -> dict[str, Pose]:
    starts = {} if companion is None else dict(companion.start_poses)
    for name, arm in config.arms.items():
        if arm.start_pose is not None:
            starts[name] = arm.start_pose
        elif name not in starts:
            raise DeviceError(
                f"arms.{name}.start is missing: give the sensor's world pose at the start of an episode, "
                "some cm away from any object"
            )
    return starts


def _make_touch_sensing(
    config: RigConfig,
    arms: Mapping[str, CommandedArm],
    sensors: Mapping[str, TactileSource],
    normalisers: Mapping[str, Normaliser],
    monitor: GelMonitor,
) -> TouchSensing | None:
    """Measures touch in images if `touch_signal` is given, otherwise by force. None if neither is given, or no arm
    carries a sensor."""
    missed_periods = 2.5  # an approach waits if no image arrived within so many periods of its camera
    carriers = {sensor.arm: arms[sensor.arm] for sensor in config.sensors.values() if sensor.arm is not None}
    if not carriers:
        return None
    if config.start.touch_signal is not None:
        rates = [
            _require_positive(driver.sample_rate(), driver, f"sensors.{name}", "a sample rate", "Hz")
            for name, driver in sensor_drivers(config).items()
        ]
        data_timeout = missed_periods / min(rates)
        return PictureTouch(sensors, normalisers, monitor, config.start.touch_signal, data_timeout)
    force = None if config.task is None else config.task.touch_force
    return None if force is None else ForceTouch(carriers, force)


def _require_safe_approach_speed(config: RigConfig, sensors: SensorDrivers, arms: ArmDrivers) -> None:
    """Raises ValueError if a gel could be pressed beyond its limit before its image shows the touch."""
    if config.start.touch_signal is None:
        return
    for name, driver in sensors.items():
        arm = driver.config.arm
        if arm is None or (depth := _stop_limits_of(config, arm).depth) is None:
            continue
        delay = _require_positive(driver.worst_latency(), driver, f"sensors.{name}", "a worst latency", "s")
        delay += _require_positive(arms[arm].worst_latency(), arms[arm], f"arms.{arm}", "a worst latency", "s")
        speed = config.start.approach_speed
        if speed * delay > depth:
            raise ValueError(
                f"rig '{config.name}': start.approach_speed {1e3 * speed:g} mm/s is too fast: the image of sensor "
                f"'{name}' shows a touch {1e3 * delay:.0f} ms late, with its gel {1e3 * speed * delay:.2g} mm deep, "
                f"and limits.depth of arm '{arm}' is {1e3 * depth:g} mm. At most {1e3 * depth / delay:.2g} mm/s"
            )


def _require_positive(
    value: float, driver: SensorDriver[Any] | ArmDriver[Any], key: str, what: str, unit: str
) -> float:
    """`value`, as stated by a driver. Raises ValueError unless it is finite and positive."""
    if not (math.isfinite(value) and value > 0.0):
        raise ValueError(
            f"{key}: the driver '{driver.config.driver}' states {what} of {value} {unit}; it must be finite and above "
            "0, or an approach could press a gel too deep"
        )
    return value


def _require_keep_outs(config: RigConfig, arms: ArmDrivers) -> None:
    """Raises ValueError for two arms whose drivers do not keep them apart."""
    for rule in config.keep_out:
        first, second = (arms[name] for name in rule.arms)
        if not (first.keeps_distances and type(first) is type(second)):
            raise ValueError(
                f"rig '{config.name}': keep_out of {' and '.join(rule.arms)}: their drivers, "
                f"'{first.config.driver}' and '{second.config.driver}', do not keep their arms apart; leave keep_out "
                "out, and keep them apart by workspaces and planes"
            )


def _stop_limits_of(config: RigConfig, name: str) -> ArmLimits:
    """Raises ValueError for an arm without limits: no driver could stop it."""
    arm = config.arms[name]
    if arm.stop_limits is None:
        raise ValueError(
            f"rig '{config.name}': arms.{name} has the driver '{arm.driver}', whose configuration has no `limits`: "
            "no value says where the arm must stop. Give it `limits: ArmLimits`"
        )
    return arm.stop_limits


def _make_gel_monitor(
    config: RigConfig, sensors: Mapping[str, SensorSpec], arms: Mapping[str, CommandedArm]
) -> GelMonitor:
    """Reports tactile values to the arms, and checks the limits of the gels. Raises DeviceError for a limit that cannot
    be checked because its sensor delivers no height or flow."""
    limits = {name: _stop_limits_of(config, name) for name in config.arms}
    report = {name: arm.driver.report_tactile for name, arm in arms.items()}
    try:
        return GelMonitor(sensors, limits, report, SafetyViolation)
    except ValueError as failure:
        raise DeviceError(str(failure)) from None


def _make_confirmation(
    config: RigConfig, companion: Companion | None, confirm: Confirm | None, *, is_real: bool
) -> Callable[[], bool]:
    def confirm_placement() -> bool:
        if is_real:
            question = (
                CONFIRMATION_QUESTION
                if len(config.arms) == 1
                else CONFIRMATION_QUESTION.replace("sensor", "sensors").replace("arm", "arms")
            )
            return confirm is not None and confirm(f"Rig '{config.name}': {question}")
        if companion is not None:
            companion.place()
        return True

    return confirm_placement

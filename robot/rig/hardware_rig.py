"""Rigs that go by the wall clock: UR arms and cameras, real or mock, and simulated sensors on them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING

from calibration.errors import error_context
from robot.arm.time_alignment import ArmHistory
from robot.arm.trajectory import PERIOD
from robot.arm.ur import URArm
from robot.camera.camera import Camera
from robot.errors import DeviceError, SafetyViolation
from robot.mock.cell.cell import MockCell
from robot.rig.clock import Driven, LockStep, WallClock
from robot.rig.reset import GuidedStart
from robot.rig.twin_sensor import TwinSensor
from tacsim import pose as se3
from tacsim.control.admittance import held_loads
from tacsim.control.contact_signal import contact_signal
from tacsim.control.gel_monitor import GelMonitor
from tacsim.interface import ArmState, Normaliser, Pose, TactileSource
from tacsim.limits import ActionError
from tacsim.models.hardware import CameraSensorConfig, UrArmConfig
from tacsim.models.rig import RigConfig, SimSensorConfig
from tacsim.report.timing import ALIGNMENT, LIMITS
from tacsim.rig import Rig

if TYPE_CHECKING:
    from calibration.normaliser import FrameNormaliser

Confirm = Callable[[str], bool]
SHORTENED = 1e-7  # a target that was changed by more counts as shortened [m, rad]
QUESTION = "Is the body in its place between the sensors, and everybody out of reach of the arms?"


class RigArm:
    """One UR arm as the rig has it: it remembers where it was asked to go, for the clock to wait for.

    still: no motion is ever sent (a dry run).
    """

    def __init__(self, driven: Driven, *, still: bool = False) -> None:
        self._driven, self._still = driven, still
        self.alignment = 0.0  # of the last aligned state: time to the nearest package [s]
        self.limits_hit = 0  # targets that were shortened or refused

    def state(self, at: float | None = None) -> ArmState:
        """Raises NotAligned for a moment of which no package tells."""
        arm = self._driven.arm
        if at is None:
            return arm.state()
        deadline = time.monotonic() + arm.config.link_timeout
        while arm.state().time < at and time.monotonic() < deadline:  # a package comes later than what it tells of
            time.sleep(1e-3)
        packages = max(8, math.ceil((time.monotonic() - at) / PERIOD) + 8)  # from before that moment to now
        history = ArmHistory(arm.name, max_gap=arm.config.link_timeout)  # a longer gap is a lost link
        for state in arm.history(packages):
            history.append(state)
        aligned = history.at(at)
        self.alignment = aligned.error
        return aligned.state

    def command(self, target: Pose | None) -> Pose | None:
        """With `still` nothing is sent, and None says so."""
        if self._still:
            return None
        try:
            sent = self._driven.arm.command(target)
        except ActionError:
            self.limits_hit += 1
            raise
        self.limits_hit += target is not None and sent is not None and max(se3.distance(target, sent)) > SHORTENED
        self._driven.target = sent
        return sent

    def unwatch(self) -> None:
        """For motions that are not decided by observations: they need not be fresh, until the next one is made."""
        self._driven.arm.report_tactile(None)

    def stop(self) -> None:
        self._driven.target = None
        self._driven.arm.stop()

    def recover(self) -> None:
        self._driven.target = None
        self._driven.arm.recover()

    def close(self) -> None:
        self._driven.arm.close()


def open_wall(config: RigConfig, confirm: Confirm | None, *, dry_run: bool = False) -> Rig:
    """Opens a rig of hardware. Starts the mocks that its file asks for. Connects; moves nothing.

    confirm: asks a person a question before anything approaches the body; not needed where all arms are mocks.
    dry_run: connects, sees, feels, times and records, but no motion is sent, neither by reset nor by step.

    Raises DeviceError for what cannot be opened, calibration.errors.CalibrationError for a calibration,
    ValueError for a rig that makes no sense.
    """
    real = [name for name, arm in config.arms.items() if isinstance(arm, UrArmConfig) and arm.mock is None]
    # first, because a wrong calibration is known before anything is connected
    normalisers = {name: _normaliser(name, sensor, config) for name, sensor in config.sensors.items()}
    with ExitStack() as stack:
        cell = stack.enter_context(MockCell(config))
        sensors: dict[str, TactileSource] = {}
        for name, sensor in config.sensors.items():
            sensors[name] = _sensor(name, sensor, cell)
            stack.callback(sensors[name].close)
        arms: dict[str, Driven] = {}
        for name, arm in config.arms.items():
            assert isinstance(arm, UrArmConfig)
            opened = URArm(arm, name, keep_out=config.kept_out(name))
            stack.callback(opened.close)
            arms[name] = Driven(opened)
        cameras = {name: sensor for name, sensor in sensors.items() if isinstance(sensor, Camera)}
        fed = {name: camera for name, camera in cameras.items() if name in cell.cameras}
        lock_step = config.lock_step and not real and cell.simulated
        clock: LockStep | WallClock
        if lock_step:
            clock = LockStep(config.period, arms, fed, cell)
        elif cell.simulated:
            cell.run_free()
            clock = WallClock(config.period, cell.catch_up)
        else:
            clock = WallClock(config.period)
        for name, camera in cameras.items():  # what the normaliser finds in the picture is delivered too
            found = normalisers[name]
            camera.spec = replace(camera.spec, height=found.finds_height, flow=found.finds_flow)
        task = config.task
        start = GuidedStart(
            arms={} if dry_run else arms,
            sensors=sensors,
            start=_starts(config, cell),
            clock=clock,
            config=config.start,
            feel=None if dry_run else _feel(config, arms, sensors, normalisers),
            confirm=_confirmed(config, cell, confirm, real=bool(real) and not dry_run),
            placement=0.0 if task is None else task.placement,
        )

        behind = {name: RigArm(driven, still=dry_run) for name, driven in arms.items()}

        def diagnostics() -> Mapping[str, float]:
            found = {**cell.diagnostics(), **clock.diagnostics()}
            for name, arm in behind.items():
                found |= {f"{ALIGNMENT}{name}": arm.alignment, f"{LIMITS}{name}": float(arm.limits_hit)}
            return found

        rig = Rig(
            name=config.name,
            sensors=sensors,
            arms=behind,
            clock=clock,
            normalisers=normalisers,
            reset=start,
            truth=cell.truth if cell.knows_truth else None,
            diagnostics=diagnostics,
            on_close=cell.close,
            on_tactile=_watch(config, sensors, arms),
            admittance=held_loads(config.task),
        )
        stack.pop_all()
        return rig


def _sensor(name: str, config: object, cell: MockCell) -> TactileSource:
    if isinstance(config, CameraSensorConfig):
        return Camera(config, name)
    assert isinstance(config, SimSensorConfig)
    return TwinSensor(cell, name, config)


def _starts(config: RigConfig, cell: MockCell) -> dict[str, Pose]:
    starts = dict(cell.start)
    for name, arm in config.arms.items():
        assert isinstance(arm, UrArmConfig)
        if arm.start is not None:
            starts[name] = arm.start.pose
        elif name not in starts:
            raise DeviceError(f"arms.{name}.start is missing: world_from_sensor where an episode begins, clear of all")
    return starts


def _feel(
    config: RigConfig,
    arms: Mapping[str, Driven],
    sensors: Mapping[str, TactileSource],
    normalisers: Mapping[str, Normaliser],
) -> Callable[[], float] | None:
    """How hard the gels touch over what counts as touch: by the picture if `touch_signal` is given, else by force."""
    signal = config.start.touch_signal
    if signal is not None:

        def seen() -> float:
            found = [contact_signal(normalisers[name](sensor.read(1.0), 0.0)) for name, sensor in sensors.items()]
            return min(found) / signal

        return seen
    force = None if config.task is None else config.task.touch_force
    carrying = [sensor.arm for sensor in config.sensors.values() if sensor.arm is not None]
    if force is None or not carrying:
        return None

    def felt() -> float:
        return min(-float(arms[name].arm.state().wrench[2]) for name in carrying) / force

    return felt


def _watch(config: RigConfig, sensors: Mapping[str, TactileSource], arms: Mapping[str, Driven]) -> GelMonitor:
    """Tells the arms what their gels show, and guards those by it. Raises DeviceError for a limit that cannot be
    watched, because its sensor delivers no height or flow."""
    limits = {name: arm.limits for name, arm in config.arms.items() if isinstance(arm, UrArmConfig)}
    tell = {name: driven.arm.report_tactile for name, driven in arms.items()}
    try:
        return GelMonitor({name: sensor.spec for name, sensor in sensors.items()}, limits, tell, SafetyViolation)
    except ValueError as failure:
        raise DeviceError(str(failure)) from None


def _confirmed(config: RigConfig, cell: MockCell, confirm: Confirm | None, *, real: bool) -> Callable[[], bool]:
    def ask() -> bool:
        if real:
            return confirm is not None and confirm(f"Rig '{config.name}': {QUESTION}")
        cell.place()
        return True

    return ask


def _normaliser(name: str, config: object, rig: RigConfig) -> FrameNormaliser:
    from calibration.normaliser import normaliser_for_simulation

    if isinstance(config, CameraSensorConfig):
        return camera_normaliser(name, config, rig)
    assert isinstance(config, SimSensorConfig) and rig.scene is not None
    return normaliser_for_simulation(config.model, rig.scene.gel.size[:2], rig.canonical)


def camera_normaliser(name: str, config: CameraSensorConfig, rig: RigConfig) -> FrameNormaliser:
    """The normaliser of one camera of a rig. Raises ValueError, and
    calibration.errors.CalibrationError, which names the sensor."""
    from calibration.normaliser import normaliser_for_camera

    with error_context(f"sensors.{name}"):
        return normaliser_for_camera(
            config, config.size if rig.scene is None else rig.scene.gel.size[:2], rig.canonical
        )

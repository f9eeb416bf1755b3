"""Rigs that go by the wall clock: UR arms and cameras, real or mock, and simulated sensors on them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing

from calibration.errors import error_context
from calibration.frame_normaliser import FrameNormaliser
from calibration.normaliser import normaliser_for_camera, normaliser_for_simulation
from robot.arm.ur import URArm
from robot.arm.worker_config import check_host
from robot.camera.camera import Camera
from robot.errors import DeviceError, SafetyViolation
from robot.mock.cell.cell import MockCell
from robot.rig.clock import LockStep, WallClock
from robot.rig.commanded_arm import CommandedArm
from robot.rig.reset import HardwareReset
from robot.rig.touch import ForceTouch, PictureTouch, TouchSense
from tacsim.control.gel_monitor import GelMonitor
from tacsim.control.load_controller import load_controller
from tacsim.interface import Normaliser, Pose, RigSpec, SensorSpec, TactileFrame, TactileSource
from tacsim.models.hardware import CameraSensorConfig, UrArmConfig
from tacsim.models.rig import RigConfig, SimSensorConfig
from tacsim.rig import Rig
from tacsim.step_info import ALIGNMENT, LIMITS_HIT, PICTURES_DAMAGED, PICTURES_LOST, PICTURES_REPEATED

Confirm = Callable[[str], bool]
MISSED = 2.5  # an approach waits when no picture came for so many periods of its camera
SIMULATED_RATE = 10.0  # of sensors without a camera [Hz]
UNMEASURED = 0.05  # latency of a camera whose file says 0, as far as an approach may trust it [s]
REACTION = 0.05  # from a picture that shows a touch to an arm that brakes [s]
QUESTION = "Is the body in its place before the sensor, and everybody out of reach of the arm?"


class CellSensor:
    """A simulated sensor on a real or mock arm, without a camera: the mock cell's gel at the arm's measured pose."""

    def __init__(self, cell: MockCell, name: str, config: SimSensorConfig) -> None:
        self._cell, self._name, self.spec = cell, name, _sensor_spec(config)

    def read(self, timeout: float) -> TactileFrame:
        """The picture of the newest simulated state. Raises TimeoutError when there is none within `timeout` [s]."""
        deadline = time.monotonic() + timeout
        while (frame := self._cell.scene_frame) is None:
            if time.monotonic() > deadline:
                raise TimeoutError(f"sensor '{self._name}': the mock cell has simulated nothing within {timeout:g} s")
            time.sleep(1e-3)
        name = self._name
        return TactileFrame(frame.images[name], time=frame.time, index=frame.index, surface=frame.surfaces[name])

    def close(self) -> None:
        """The rig closes the cell."""


def open_hardware(
    config: RigConfig,
    confirm: Confirm | None,
    *,
    dry_run: bool = False,
    check: Callable[[RigSpec], None] | None = None,
    tell: Callable[[str], None] = lambda words: None,
) -> Rig:
    """Opens a rig of hardware. Starts the mocks that its file asks for. Connects; moves nothing.

    confirm: asks a person before anything approaches the body; not needed where all arms are mocks.
    dry_run: connects, observes and records, but sends no motion, neither in a reset nor in a step.
    check: is told what the rig delivers before anything is opened; raises to refuse it.
    tell: is told, again and again, what the arms are doing at a reset.

    Raises DeviceError for what cannot be opened, calibration.errors.CalibrationError for a calibration,
    ValueError for a rig that makes no sense.
    """
    real = [name for name, arm in config.arms.items() if isinstance(arm, UrArmConfig) and arm.mock is None]
    # first: a wrong calibration, host or limit, and what lacks, are known before anything is connected
    for name in config.arms:
        _ur_arm(config, name)
    normalisers = {name: _normaliser(name, sensor, config) for name, sensor in config.sensors.items()}
    spec = _spec(config, normalisers)
    _gel_monitor(config, spec.sensors, {})
    _require_gentle_approach(config)
    for name in config.arms:
        check_host(_ur_arm(config, name), name)
    if check is not None:
        check(spec)
    with ExitStack() as stack:
        cell = stack.enter_context(MockCell(config))
        sensors = {name: stack.enter_context(closing(_sensor(name, config, cell))) for name in config.sensors}
        arms = {name: stack.enter_context(closing(_arm(name, config, dry_run))) for name in config.arms}
        cameras = {name: sensor for name, sensor in sensors.items() if isinstance(sensor, Camera)}
        clock = _clock(config, cell, arms, cameras, real=bool(real))
        for name, camera in cameras.items():
            camera.spec = spec.sensors[name]
        monitor = _gel_monitor(config, spec.sensors, arms)
        task = config.task
        reset = HardwareReset(
            arms={} if dry_run else arms,
            sensors=sensors,
            start=_start_poses(config, cell),
            clock=clock,
            config=config.start,
            touch_sense=None if dry_run else _touch_sense(config, arms, sensors, normalisers, monitor),
            confirm=_confirmation(config, cell, confirm, real=bool(real) and not dry_run),
            placement=0.0 if task is None else task.placement,
            tell=tell,
        )

        logs = {name: arm.driver.package_log() for name, arm in arms.items() if config.record.arm_packages}
        rig = Rig(
            name=config.name,
            sensors=sensors,
            arms=arms,
            clock=clock,
            normalisers=normalisers,
            reset=reset,
            truth=cell.truth if cell.knows_truth else None,
            diagnostics=lambda: _diagnostics(cell, clock, arms, cameras),
            packages=lambda: {name: log.take() for name, log in logs.items()},
            on_close=cell.close,
            on_tactile=monitor,
            load_control=load_controller(config.task),
        )
        stack.pop_all()
        return rig


def _sensor(name: str, config: RigConfig, cell: MockCell) -> Camera | CellSensor:
    sensor = config.sensors[name]
    if isinstance(sensor, CameraSensorConfig):
        return Camera(sensor, name)
    return CellSensor(cell, name, _simulated(config, name))


def _simulated(config: RigConfig, name: str) -> SimSensorConfig:
    """Raises ValueError for a sensor that is neither a camera nor simulated."""
    sensor = config.sensors[name]
    if not isinstance(sensor, SimSensorConfig):
        raise ValueError(
            f"rig '{config.name}': sensors.{name} has the driver '{sensor.driver}', which a rig of hardware cannot "
            "open; use `driver: camera` or `driver: sim`"
        )
    return sensor


def _arm(name: str, config: RigConfig, dry_run: bool) -> CommandedArm:
    return CommandedArm(URArm(_ur_arm(config, name), name, keep_out=config.kept_out(name)), dry_run=dry_run)


def _clock(
    config: RigConfig,
    cell: MockCell,
    arms: Mapping[str, CommandedArm],
    cameras: Mapping[str, Camera],
    *,
    real: bool,
) -> LockStep | WallClock:
    """In lock step where everything waits for us: no real arm, and gels simulated here."""
    if not cell.simulated:
        return WallClock(config.period)
    if config.lock_step and not real:
        mock_cameras = {name: camera for name, camera in cameras.items() if name in cell.cameras}
        return LockStep(config.period, arms, mock_cameras, cell)
    cell.run_free()
    return WallClock(config.period, cell.catch_up, real_time=config.contact == "hertz")


def _diagnostics(
    cell: MockCell, clock: LockStep | WallClock, arms: Mapping[str, CommandedArm], cameras: Mapping[str, Camera]
) -> Mapping[str, float]:
    values = {**cell.diagnostics(), **clock.diagnostics()}
    for name, arm in arms.items():
        values |= {f"{ALIGNMENT}{name}": arm.alignment, f"{LIMITS_HIT}{name}": float(arm.limits_hit)}
    for name, camera in cameras.items():
        values |= camera_counts(name, camera)
    return values


def hardware_spec(config: RigConfig) -> RigSpec:
    """What a rig of hardware will deliver; nothing is opened. Raises CalibrationError, ValueError."""
    return _spec(config, {name: _normaliser(name, sensor, config) for name, sensor in config.sensors.items()})


def _spec(config: RigConfig, normalisers: Mapping[str, FrameNormaliser]) -> RigSpec:
    """What the rig will deliver; for cameras also what the normaliser finds in the picture."""
    sensors = {}
    for name, sensor in config.sensors.items():
        if isinstance(sensor, CameraSensorConfig):
            found = normalisers[name]
            size = (sensor.height, sensor.width)
            sensors[name] = SensorSpec(size, height=found.finds_height, flow=found.finds_flow, arm=sensor.arm)
        else:
            sensors[name] = _sensor_spec(_simulated(config, name))
    return RigSpec(sensors, tuple(config.arms), MockCell.will_know_truth(config), config.period)


def _sensor_spec(config: SimSensorConfig) -> SensorSpec:
    model = config.model
    return SensorSpec(model.image_shape, height=True, flow=model.markers is not None, arm=config.arm)


def _start_poses(config: RigConfig, cell: MockCell) -> dict[str, Pose]:
    starts = dict(cell.start_poses)
    for name in config.arms:
        arm = _ur_arm(config, name)
        if arm.start is not None:
            starts[name] = arm.start.pose
        elif name not in starts:
            raise DeviceError(
                f"arms.{name}.start is missing: give the sensor's world pose at the start of an episode, "
                "some cm clear of everything"
            )
    return starts


def _touch_sense(
    config: RigConfig,
    arms: Mapping[str, CommandedArm],
    sensors: Mapping[str, TactileSource],
    normalisers: Mapping[str, Normaliser],
    monitor: GelMonitor,
) -> TouchSense | None:
    """How touch is felt: by the picture if `touch_signal` is given, else by force. None where neither is given, or no
    arm carries a sensor."""
    carriers = {sensor.arm: arms[sensor.arm] for sensor in config.sensors.values() if sensor.arm is not None}
    if not carriers:
        return None
    if config.start.touch_signal is not None:
        rates = [each.fps for each in config.sensors.values() if isinstance(each, CameraSensorConfig)]
        patience = MISSED / min(rates, default=SIMULATED_RATE)
        return PictureTouch(sensors, normalisers, monitor, config.start.touch_signal, patience)
    force = None if config.task is None else config.task.touch_force
    return None if force is None else ForceTouch(carriers, force)


def _require_gentle_approach(config: RigConfig) -> None:
    """Raises ValueError where a gel would be pressed beyond its limit before its camera could tell of the touch."""
    if config.start.touch_signal is None:
        return
    for name, sensor in config.sensors.items():
        if sensor.arm is None or (depth := _ur_arm(config, sensor.arm).limits.depth) is None:
            continue
        late = _worst_latency(config, name)
        speed = config.start.approach_speed
        if speed * late > depth:
            raise ValueError(
                f"rig '{config.name}': start.approach_speed {1e3 * speed:g} mm/s is too fast: the camera of sensor "
                f"'{name}' tells of a touch {1e3 * late:.0f} ms late, with its gel {1e3 * speed * late:.2g} mm deep, "
                f"and limits.depth of arm '{sensor.arm}' is {1e3 * depth:g} mm. At most {1e3 * depth / late:.2g} mm/s"
            )


def _worst_latency(config: RigConfig, name: str) -> float:
    """Longest time from a touch to an arm that brakes, by the pictures of a sensor [s]. Raises ValueError for a driver
    whose latency is not known."""
    sensor = config.sensors[name]
    if isinstance(sensor, CameraSensorConfig):
        return max(sensor.latency, UNMEASURED) + 1.0 / sensor.fps + REACTION
    if isinstance(sensor, SimSensorConfig):
        return 1.0 / SIMULATED_RATE + REACTION
    raise ValueError(
        f"rig '{config.name}': sensors.{name} has the driver '{sensor.driver}', whose latency is not known: "
        f"how deep its gel is pressed before its picture shows a touch cannot be computed. State its worst latency in "
        f"{_worst_latency.__module__}._worst_latency"
    )


def _ur_arm(config: RigConfig, name: str) -> UrArmConfig:
    """Raises ValueError for an arm of a kind whose limits nothing here guards."""
    arm = config.arms[name]
    if not isinstance(arm, UrArmConfig):
        raise ValueError(
            f"rig '{config.name}': arms.{name} has the driver '{arm.driver}', which a rig of hardware cannot open: "
            "neither its limits nor its stops are known here. Use `driver: ur`"
        )
    return arm


def _gel_monitor(config: RigConfig, sensors: Mapping[str, SensorSpec], arms: Mapping[str, CommandedArm]) -> GelMonitor:
    """Reports to the arms what their gels show, and guards the gels. Raises DeviceError for a limit that cannot be
    guarded because its sensor delivers no height or flow."""
    limits = {name: _ur_arm(config, name).limits for name in config.arms}
    report = {name: arm.driver.report_tactile for name, arm in arms.items()}
    try:
        return GelMonitor(sensors, limits, report, SafetyViolation)
    except ValueError as failure:
        raise DeviceError(str(failure)) from None


def _confirmation(config: RigConfig, cell: MockCell, confirm: Confirm | None, *, real: bool) -> Callable[[], bool]:
    def ask() -> bool:
        if real:
            question = (
                QUESTION if len(config.arms) == 1 else QUESTION.replace("sensor", "sensors").replace("arm", "arms")
            )
            return confirm is not None and confirm(f"Rig '{config.name}': {question}")
        cell.place()
        return True

    return ask


def _normaliser(name: str, config: object, rig: RigConfig) -> FrameNormaliser:
    if isinstance(config, CameraSensorConfig):
        return camera_normaliser(name, config, rig)
    config = _simulated(rig, name)
    assert rig.scene is not None
    return normaliser_for_simulation(config.model, rig.scene.gel_of(name).size[:2], rig.canonical)


def camera_counts(name: str, camera: Camera) -> dict[str, float]:
    """The frames of a camera that gave no picture, by their keys in a record."""
    status = camera.status
    counts = {PICTURES_LOST: status.dropped, PICTURES_DAMAGED: status.damaged, PICTURES_REPEATED: status.repeated}
    return {key + name: float(count) for key, count in counts.items()}


def camera_normaliser(name: str, config: CameraSensorConfig, rig: RigConfig) -> FrameNormaliser:
    """The normaliser of one camera of a rig. Raises ValueError, and
    calibration.errors.CalibrationError, which names the sensor."""
    with error_context(f"sensors.{name}"):
        return normaliser_for_camera(
            config, config.size if rig.scene is None else rig.scene.gel_of(name).size[:2], rig.canonical
        )

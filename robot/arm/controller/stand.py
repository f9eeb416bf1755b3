"""Where an arm stands, what it feels and carries, as its controller tells it, against what the rig file says."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from robot.arm.controller.rtde import ControllerReading
from robot.common.kinematics import Kinematics, displacement, inverse_frame, matrix, pose, rotation_vector
from robot.common.tcp import ArmFrames
from tacsim import pose as se3
from tacsim.interface import FloatArray, Pose
from tacsim.limits import ROUNDING
from tacsim.models.driver import Check, State
from tacsim.models.hardware import UrArmConfig

OFF_FORCE = 1.0  # a sensor that feels more at rest is zeroed before an episode [N]


@dataclass(frozen=True, slots=True, eq=False)
class Stand:
    """An arm as it stands."""

    reading: ControllerReading
    flange: FloatArray  # base_from_flange (4, 4)
    tcp: FloatArray  # flange_from_tcp (4, 4) of the controller: with it the pendant shows its poses
    sensor: FloatArray  # world_from_sensor (4, 4)
    wrench: FloatArray  # (6,) about the sensor's origin, its axes [N, N m]
    expected_wrench: FloatArray  # (6,) the same once the controller is told of the file's payload


def stand(config: UrArmConfig, reading: ControllerReading) -> Stand:
    """From what a controller configured."""
    gravity = 9.82  # [m/s^2]
    frames = ArmFrames.of(config)
    shown = matrix(reading.tcp_pose)
    if reading.tcp is None:  # an old controller: by the nominal lengths of the model, to a millimetre or so
        tcp = inverse_frame(Kinematics(config.model).forward(reading.joints)) @ shown
    else:
        tcp = matrix(reading.tcp)
    flange = shown @ inverse_frame(tcp)
    sensor = frames.world_from_base @ flange @ frames.flange_from_tool @ frames.tool_from_sensor
    weight = np.zeros(6)  # what the force changes by when the controller is told another payload
    if reading.payload is not None and reading.payload_centre is not None:
        up = frames.world_from_base[2, :3]
        for mass, centre in (
            (config.payload.mass, config.payload.centre),
            (-reading.payload, reading.payload_centre),
        ):
            lever = flange[:3, :3] @ np.array(centre) + flange[:3, 3] - shown[:3, 3]
            weight += mass * gravity * np.concatenate([up, np.cross(lever, up)])
    base_from_sensor = inverse_frame(frames.world_from_base) @ sensor

    def at_sensor(wrench: FloatArray) -> FloatArray:
        torque = wrench[3:] - np.cross(base_from_sensor[:3, 3] - shown[:3, 3], wrench[:3])
        turn = base_from_sensor[:3, :3].T
        return np.concatenate([turn @ wrench[:3], turn @ torque])

    return Stand(reading, flange, tcp, sensor, at_sensor(reading.tcp_force), at_sensor(reading.tcp_force + weight))


def on_pendant(config: UrArmConfig, now: Stand, sensor: Pose) -> FloatArray:
    """(6,) what the pendant shows (feature Base, its TCP) when the sensor is at a pose in the world [m, rad]."""
    return pose(ArmFrames.of(config).flange(se3.to_matrix(sensor)) @ now.tcp)


def compare(name: str, config: UrArmConfig, now: Stand, start: Pose | None, file: str) -> Iterator[Check]:
    """The checks of one arm. `start` is where an episode begins, `file` the rig file, for the commands to be typed."""
    place = now.sensor[:3, 3]
    words = f"sensor at {_mm(place)} mm in the world; the pendant (feature Base) shows {_shown(now.reading.tcp_pose)}"
    yield _model(name, config, now) or Check(f"{name}: pose", "ok", words)
    yield _workspace(name, config, place, file)
    if start is not None:
        yield _way_to_start(name, config, now, start)
    yield _force(name, config, now, file)
    yield _payload(name, config, now)
    yield _tcp(name, config, now)
    yield _slider(name, now)


def _model(name: str, config: UrArmConfig, now: Stand) -> Check | None:
    """A failed check where joints and pose do not belong to the model of the file."""
    limit = 20e-3  # a pose farther than this from that of the model is of another model [m]
    found = displacement(Kinematics(config.model).forward(now.reading.joints), now.flange)
    if now.reading.tcp is None or float(np.linalg.norm(found[:3])) < limit:
        return None
    far = f"its flange is {1e3 * float(np.linalg.norm(found[:3])):.0f} mm from where a {config.model} would have it"
    return Check(f"{name}: pose", "fail", far, "correct model in the rig file")


def _workspace(name: str, config: UrArmConfig, place: FloatArray, file: str) -> Check:
    label, region = f"{name}: workspace", config.limits.region
    beyond = region.normals @ place - region.offsets
    broken = [int(face) for face in np.argsort(-beyond) if beyond[face] > ROUNDING]
    if not broken:
        nearest = int(beyond.argmax())
        return Check(label, "ok", f"inside, {-1e3 * beyond[nearest]:.0f} mm from {region.names[nearest]}")
    base_from_world = ArmFrames.of(config).world_from_base[:3, :3].T
    faces = "; ".join(f"{1e3 * beyond[face]:.3g} mm beyond {region.names[face]}" for face in broken)
    back = base_from_world @ -np.sum([beyond[face] * region.normals[face] for face in broken], axis=0)
    return Check(
        label,
        "fail",
        f"outside: {faces}. Back inside by {_by(back)} on the pendant",
        f"{_lead(file)}; or jog it there by hand (way to start, below)",
    )


def _way_to_start(name: str, config: UrArmConfig, now: Stand, start: Pose) -> Check:
    target, here = on_pendant(config, now, start), now.reading.tcp_pose
    turn = rotation_vector(matrix(target)[:3, :3] @ matrix(here)[:3, :3].T)
    degrees = np.degrees(float(np.linalg.norm(turn)))
    far = 1e3 * float(np.linalg.norm(target[:3] - here[:3]))
    words = f"{far:.0f} mm and {degrees:.0f} deg away: {_by(target[:3] - here[:3])}; on the pendant {_shown(target)}"
    return Check(f"{name}: way to start", "ok", words)


def _force(name: str, config: UrArmConfig, now: Stand, file: str) -> Check:
    label, limits = f"{name}: force", config.limits
    force, torque = _sizes(now.wrench)
    then, turning = _sizes(now.expected_wrench)
    words = f"{force:.1f} of {limits.force:g} N, {torque:.2f} of {limits.torque:g} N m at the sensor"
    if abs(then - force) > 0.1:
        words += f"; {then:.1f} N, {turning:.2f} N m once the controller has the file's payload"
    if then > limits.force or turning > limits.torque:
        advice = f"no run can start so: is it free of everything? Then `tacsim start {file}` zeroes it"
        return Check(label, "fail", words, advice)
    if then > OFF_FORCE:
        advice = f"free of everything, it should be below {OFF_FORCE:g} N: see payload; `tacsim start {file}` zeroes it"
        return Check(label, "warn", words, advice)
    return Check(label, "ok", words)


def _payload(name: str, config: UrArmConfig, now: Stand) -> Check:
    max_mass_error, max_centre_error = 0.05, 10e-3  # payloads this near to each other are the same [kg, m]
    label, configured, reading = f"{name}: payload", config.payload, now.reading
    wanted = f"{configured.mass:g} kg at {_mm(np.array(configured.centre))} mm"
    if reading.payload is None or reading.payload_centre is None:
        return Check(label, "ok", f"not reported by this controller; connecting sets the file's, {wanted}")
    found = f"{reading.payload:.3g} kg at {_mm(reading.payload_centre)} mm"
    away = float(np.linalg.norm(reading.payload_centre - np.array(configured.centre)))
    is_centre_equal = configured.mass <= max_mass_error or away <= max_centre_error
    if abs(reading.payload - configured.mass) <= max_mass_error and is_centre_equal:
        return Check(label, "ok", found)
    advice = "connecting sets the file's; which of the two was weighed? A wrong one is felt as a force"
    return _own(config, Check(label, "warn", f"the controller has {found}, the file says {wanted}", advice))


def _tcp(name: str, config: UrArmConfig, now: Stand) -> Check:
    max_distance, max_angle = 0.5e-3, 5e-3  # TCPs this near to each other are the same [m, rad]
    label, wanted = f"{name}: TCP", se3.to_matrix(config.flange_from_tool.pose)
    if now.reading.tcp is None:
        return Check(
            label, "ok", f"not reported by this controller; connecting sets the file's, {_shown(pose(wanted))}"
        )
    shift, turn = np.linalg.norm(displacement(wanted, now.tcp).reshape(2, 3), axis=1)
    if shift <= max_distance and turn <= max_angle:
        return Check(label, "ok", _shown(pose(now.tcp)))
    found = f"the controller has {_shown(pose(now.tcp))}, the file says {_shown(pose(wanted))}"
    advice = "connecting sets the file's; until then the pendant's poses are those of its own TCP, here too"
    return _own(config, Check(label, "warn", found, advice))


def _slider(name: str, now: Stand) -> Check:
    label, slider = f"{name}: speed slider", now.reading.speed_slider
    if slider is None:
        return Check(label, "ok", "not reported by this controller")
    if slider > 0.995:
        return Check(label, "ok", "100 %")
    advice = (
        "motions are slower than commanded, and an arm that lags is reported as late: set it to 100 % on the pendant"
    )
    return Check(label, "warn", f"{100 * slider:.0f} %", advice)


def _own(config: UrArmConfig, check: Check) -> Check:
    """Nobody has set up the pendant of a mock that its file asks for: there a difference is no warning."""
    state: State = check.state if config.mock is None else "ok"
    return Check(check.name, state, check.found, check.advice if config.mock is None else "")


def _lead(file: str) -> str:
    return f"`tacsim start {file}` leads it to its start, after your yes"


def _sizes(wrench: FloatArray) -> tuple[float, float]:
    force, torque = np.linalg.norm(wrench.reshape(2, 3), axis=1).tolist()
    return force, torque


def _mm(vector: FloatArray) -> str:
    return "[" + ", ".join(f"{round(1e3 * value) + 0}" for value in vector) + "]"


def _by(shift: FloatArray) -> str:
    return ", ".join(f"{axis} {round(1e3 * value):+d}" for axis, value in zip("XYZ", shift, strict=True)) + " mm"


def _shown(found: FloatArray) -> str:
    """A UR pose (6,) as the pendant shows it."""
    parts = [f"{axis} {round(1e3 * value, 1) + 0.0:.1f}" for axis, value in zip("XYZ", found[:3], strict=True)]
    turns = [f"R{axis} {round(value, 3) + 0.0:.3f}" for axis, value in zip("XYZ", found[3:], strict=True)]
    return f"{' '.join(parts)} mm, {' '.join(turns)} rad"

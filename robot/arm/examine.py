"""Checks of a UR arm before anything moves: network, versions, remote control, limits; and pose, force and payload that
its controller reports, against the rig file.

The checks connect to the dashboard and to the RTDE port. They claim no input register and send no program, so another
program can drive the arm at the same time.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from robot.arm.connections import DASHBOARD_PORT, RTDE_PORT, ControllerReading, Dashboard, read_controller
from robot.common import MOCK_SERIAL
from robot.common.kinematics import Kinematics, displacement, inverse_frame, matrix, pose, rotation_vector
from robot.common.tcp import ArmFrames
from robot.errors import DeviceError
from tacsim import pose as se3
from tacsim.interface import FloatArray, Pose
from tacsim.limits import ROUNDING
from tacsim.models.driver import ArmExamination, Check, State
from tacsim.models.hardware import UrArmConfig

PORTS = {DASHBOARD_PORT: "dashboard", 30003: "script", RTDE_PORT: "RTDE"}
TIMEOUT = 2.0  # of each connection [s]
MAX_ZERO_FORCE = 1.0  # a sensor that reports more at rest is zeroed before an episode [N]


def examine(name: str, config: UrArmConfig, start: Pose | None, file: str) -> ArmExamination:
    """The checks of one arm, and the pose of its sensor.

    Args:
        start: world_from_sensor at the start of an episode.
        file: name of the rig file, for the commands in the advice.
    """
    placements: list[ArmPlacement] = []
    checks = list(_run_checks(name, config, start, file, placements))
    return ArmExamination(checks, se3.from_matrix(placements[0].sensor) if placements else None)


def _run_checks(
    name: str, config: UrArmConfig, start: Pose | None, file: str, placements: list[ArmPlacement]
) -> Iterator[Check]:
    closed = [f"{port} ({what})" for port, what in PORTS.items() if not _is_open(config.host, port)]
    if closed:
        advice = "is the controller on, the address right, and the service allowed (Settings, Security, Services)?"
        yield Check(f"{name}: network", "fail", f"{config.host}: no answer at {', '.join(closed)}", advice)
        return
    yield Check(f"{name}: network", "ok", f"{config.host}: ports {', '.join(map(str, PORTS))} answer")
    try:
        with Dashboard(config.host, TIMEOUT) as dashboard:
            yield from _check_controller(name, config, dashboard)
    except DeviceError as failure:
        yield Check(f"{name}: dashboard", "fail", str(failure), "restart the controller, and read its log")
    try:
        placement = measure_placement(config, read_controller(config.host, TIMEOUT))
    except DeviceError as failure:
        yield Check(f"{name}: RTDE", "fail", str(failure), "restart the controller")
    else:
        placements.append(placement)
        yield Check(f"{name}: RTDE", "ok", "version 2")
        yield from check_placement(name, config, placement, start, file)
    yield _describe_limits(name, config)
    yield _check_start(name, config)


def _is_open(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), TIMEOUT).close()
    except OSError:
        return False
    return True


def _check_controller(name: str, config: UrArmConfig, dashboard: Dashboard) -> Iterator[Check]:
    min_polyscope = (5, 6)  # the first version that reports remote control
    version = dashboard.request("PolyscopeVersion")
    found = re.search(r"(\d+)\.(\d+)\.\d+", version)
    fit = found is not None and (int(found[1]), int(found[2])) >= min_polyscope
    lowest = ".".join(map(str, min_polyscope))
    advice = "" if fit else f"update PolyScope to {lowest} or later: older versions do not report remote control"
    yield Check(f"{name}: PolyScope", "ok" if fit else "warn", version, advice)
    model, serial = dashboard.model(), dashboard.serial()
    wrong = model is not None and not config.model.startswith(model)
    yield Check(
        f"{name}: model",
        "fail" if wrong else "ok",
        f"{(model or 'not reported').upper()}, serial number {serial}",
        f"the file says {config.model}; correct one of the two" if wrong else "",
    )
    if config.serial not in (None, serial):
        advice = "is it the right robot, at the right address? Else correct serial in the rig file"
        words = f"the robot has {serial}, the file says {config.serial}"
        yield Check(f"{name}: serial number", "fail", words, advice)
    mock = serial == MOCK_SERIAL
    if mock != (config.mock is not None):
        yield Check(
            f"{name}: kind", "fail", "a mock" if mock else "a real arm", "the file says otherwise (`mock:` block)"
        )
    try:
        dashboard.require_ready(f"arm '{name}'")
        words = f"robot mode {dashboard.mode()}, safety {dashboard.safety()}, remote control"
        program = dashboard.program()
        busy = program == "PLAYING"
        advice = "another program drives it: end that one before a run" if busy else ""
        yield Check(f"{name}: ready", "warn" if busy else "ok", f"{words}, program {program}", advice)
    except DeviceError as failure:
        yield Check(f"{name}: ready", "fail", str(failure), "correct it at the pendant, then check again")


def _describe_limits(name: str, config: UrArmConfig) -> Check:
    limits = config.limits
    size = 1e3 * (np.array(limits.workspace.upper) - limits.workspace.lower)
    words = (
        f"workspace {size[0]:.0f} x {size[1]:.0f} x {size[2]:.0f} mm, {len(limits.planes)} walls, "
        f"{1e3 * limits.speed:.0f} mm/s, {limits.acceleration:g} m/s², {limits.force:g} N, {limits.torque:g} N m"
    )
    advice = (
        "these limits protect the work, not people: set the safety limits on the pendant too"
        if config.mock is None
        else ""
    )
    return Check(f"{name}: limits", "ok", words, advice)


def _check_start(name: str, config: UrArmConfig) -> Check:
    """Checks that the start pose is in the workspace and within reach."""
    label = f"{name}: start"
    if config.start is None:
        if config.mock is not None:
            return Check(label, "ok", "given by the scene")
        return Check(label, "fail", "missing", "give start: world_from_sensor, clear of everything")
    place = np.array(config.start.position)
    if (place < config.limits.workspace.lower).any() or (place > config.limits.workspace.upper).any():
        return Check(label, "fail", f"{place.tolist()} m is outside the workspace", "correct start or limits.workspace")
    kinematics = Kinematics(config.model)
    postures = kinematics.solutions(ArmFrames.of(config).flange(se3.to_matrix(config.start.pose)), np.zeros(6))
    if not postures:
        return Check(
            label, "fail", f"{place.tolist()} m is out of reach", "correct start, world_from_base, or the mount"
        )
    far = max(kinematics.singularity(posture) for posture in postures)
    state, advice = ("ok", "") if far > 0.05 else ("warn", "near a singular posture: place the base elsewhere")
    return Check(label, state, f"within reach, {far:.2f} from a singularity (0.1 to 0.3 is good)", advice)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True, eq=False)
class ArmPlacement:
    """Pose and wrench of an arm at one moment."""

    reading: ControllerReading
    flange: FloatArray  # base_from_flange (4, 4)
    tcp: FloatArray  # flange_from_tcp (4, 4) of the controller, for which the pendant shows poses
    sensor: FloatArray  # world_from_sensor (4, 4)
    wrench: FloatArray  # (6,) about the sensor's origin, its axes [N, N m]
    expected_wrench: FloatArray  # (6,) the same with the payload of the rig file


def measure_placement(config: UrArmConfig, reading: ControllerReading) -> ArmPlacement:
    """The placement of an arm from one reading of its controller."""
    gravity = 9.82  # [m/s^2]
    frames = ArmFrames.of(config)
    tcp_pose = matrix(reading.tcp_pose)
    if reading.tcp is None:  # an old controller: from the nominal lengths of the model, accurate to about 1 mm
        tcp = inverse_frame(Kinematics(config.model).forward(reading.joints)) @ tcp_pose
    else:
        tcp = matrix(reading.tcp)
    flange = tcp_pose @ inverse_frame(tcp)
    sensor = frames.world_from_base @ flange @ frames.flange_from_tool @ frames.tool_from_sensor
    weight = np.zeros(6)  # change of the reported wrench if the controller had the payload of the file
    if reading.payload is not None and reading.payload_centre is not None:
        up = frames.world_from_base[2, :3]
        for mass, centre in (
            (config.payload.mass, config.payload.centre),
            (-reading.payload, reading.payload_centre),
        ):
            lever = flange[:3, :3] @ np.array(centre) + flange[:3, 3] - tcp_pose[:3, 3]
            weight += mass * gravity * np.concatenate([up, np.cross(lever, up)])
    base_from_sensor = inverse_frame(frames.world_from_base) @ sensor

    def at_sensor(wrench: FloatArray) -> FloatArray:
        torque = wrench[3:] - np.cross(base_from_sensor[:3, 3] - tcp_pose[:3, 3], wrench[:3])
        turn = base_from_sensor[:3, :3].T
        return np.concatenate([turn @ wrench[:3], turn @ torque])

    return ArmPlacement(
        reading, flange, tcp, sensor, at_sensor(reading.tcp_force), at_sensor(reading.tcp_force + weight)
    )


def pendant_pose(config: UrArmConfig, placement: ArmPlacement, sensor: Pose) -> FloatArray:
    """(6,) pose [m, rad] on the pendant (feature Base, its TCP) for a pose of the sensor in the world."""
    return pose(ArmFrames.of(config).flange(se3.to_matrix(sensor)) @ placement.tcp)


def check_placement(
    name: str, config: UrArmConfig, placement: ArmPlacement, start: Pose | None, file: str
) -> Iterator[Check]:
    """The checks of one arm. start: pose of the sensor at the start of an episode. file: name of the rig file, for the
    commands in the advice."""
    place = placement.sensor[:3, 3]
    shown = _format_pose(placement.reading.tcp_pose)
    words = f"sensor at {format_millimetres(place)} mm in the world; the pendant (feature Base) shows {shown}"
    yield _check_model(name, config, placement) or Check(f"{name}: pose", "ok", words)
    yield _check_workspace(name, config, place, file)
    if start is not None:
        yield _describe_start_distance(name, config, placement, start)
    yield _check_force(name, config, placement, file)
    yield _check_payload(name, config, placement)
    yield _check_tcp(name, config, placement)
    yield _check_slider(name, placement)


def _check_model(name: str, config: UrArmConfig, placement: ArmPlacement) -> Check | None:
    """A failed check if joints and pose do not fit the arm model of the file."""
    limit = 20e-3  # a larger distance from the pose of the model means another model [m]
    found = displacement(Kinematics(config.model).forward(placement.reading.joints), placement.flange)
    if placement.reading.tcp is None or float(np.linalg.norm(found[:3])) < limit:
        return None
    far = f"its flange is {1e3 * float(np.linalg.norm(found[:3])):.0f} mm from the position for model {config.model}"
    return Check(f"{name}: pose", "fail", far, "correct model in the rig file")


def _check_workspace(name: str, config: UrArmConfig, place: FloatArray, file: str) -> Check:
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
        f"outside: {faces}. Back inside by {_format_shift(back)} on the pendant",
        f"{_start_advice(file)}; or jog it there by hand (see 'path to start' below)",
    )


def _describe_start_distance(name: str, config: UrArmConfig, placement: ArmPlacement, start: Pose) -> Check:
    target, here = pendant_pose(config, placement, start), placement.reading.tcp_pose
    turn = rotation_vector(matrix(target)[:3, :3] @ matrix(here)[:3, :3].T)
    degrees = np.degrees(float(np.linalg.norm(turn)))
    far = 1e3 * float(np.linalg.norm(target[:3] - here[:3]))
    shift = _format_shift(target[:3] - here[:3])
    words = f"{far:.0f} mm and {degrees:.0f} deg away: {shift}; on the pendant {_format_pose(target)}"
    return Check(f"{name}: path to start", "ok", words)


def _check_force(name: str, config: UrArmConfig, placement: ArmPlacement, file: str) -> Check:
    label, limits = f"{name}: force", config.limits
    force, torque = _magnitudes(placement.wrench)
    then, turning = _magnitudes(placement.expected_wrench)
    words = f"{force:.1f} of {limits.force:g} N, {torque:.2f} of {limits.torque:g} N m at the sensor"
    if abs(then - force) > 0.1:
        words += f"; {then:.1f} N, {turning:.2f} N m once the controller has the file's payload"
    if then > limits.force or turning > limits.torque:
        advice = f"no run can start: if the sensor touches nothing, `tacsim start {file}` zeroes it"
        return Check(label, "fail", words, advice)
    if then > MAX_ZERO_FORCE:
        advice = (
            f"without contact it should be below {MAX_ZERO_FORCE:g} N: see payload; `tacsim start {file}` zeroes it"
        )
        return Check(label, "warn", words, advice)
    return Check(label, "ok", words)


def _check_payload(name: str, config: UrArmConfig, placement: ArmPlacement) -> Check:
    max_mass_error, max_centre_error = 0.05, 10e-3  # payloads within these differences are the same [kg, m]
    label, configured, reading = f"{name}: payload", config.payload, placement.reading
    wanted = f"{configured.mass:g} kg at {format_millimetres(np.array(configured.centre))} mm"
    if reading.payload is None or reading.payload_centre is None:
        return Check(label, "ok", f"not reported by this controller; connecting sets the file's, {wanted}")
    found = f"{reading.payload:.3g} kg at {format_millimetres(reading.payload_centre)} mm"
    away = float(np.linalg.norm(reading.payload_centre - np.array(configured.centre)))
    is_centre_equal = configured.mass <= max_mass_error or away <= max_centre_error
    if abs(reading.payload - configured.mass) <= max_mass_error and is_centre_equal:
        return Check(label, "ok", found)
    advice = "connecting sets the file's; check which one is correct: a wrong payload acts as a force offset"
    return _accept_for_mock(config, Check(label, "warn", f"the controller has {found}, the file says {wanted}", advice))


def _check_tcp(name: str, config: UrArmConfig, placement: ArmPlacement) -> Check:
    max_distance, max_angle = 0.5e-3, 5e-3  # TCPs within these differences are the same [m, rad]
    label, wanted = f"{name}: TCP", se3.to_matrix(config.flange_from_tool.pose)
    if placement.reading.tcp is None:
        return Check(
            label, "ok", f"not reported by this controller; connecting sets the file's, {_format_pose(pose(wanted))}"
        )
    shift, turn = np.linalg.norm(displacement(wanted, placement.tcp).reshape(2, 3), axis=1)
    if shift <= max_distance and turn <= max_angle:
        return Check(label, "ok", _format_pose(pose(placement.tcp)))
    found = f"the controller has {_format_pose(pose(placement.tcp))}, the file says {_format_pose(pose(wanted))}"
    advice = "connecting sets the file's; until then the pendant, and the poses above, use its own TCP"
    return _accept_for_mock(config, Check(label, "warn", found, advice))


def _check_slider(name: str, placement: ArmPlacement) -> Check:
    label, slider = f"{name}: speed slider", placement.reading.speed_slider
    if slider is None:
        return Check(label, "ok", "not reported by this controller")
    if slider > 0.995:
        return Check(label, "ok", "100 %")
    advice = (
        "motions are slower than commanded, and an arm that lags is reported as late: set it to 100 % on the pendant"
    )
    return Check(label, "warn", f"{100 * slider:.0f} %", advice)


def _accept_for_mock(config: UrArmConfig, check: Check) -> Check:
    """The check; a mock of the file has default settings on its pendant, so there a difference is no warning."""
    state: State = check.state if config.mock is None else "ok"
    return Check(check.name, state, check.found, check.advice if config.mock is None else "")


def _start_advice(file: str) -> str:
    return f"`tacsim start {file}` moves it to its start, after you confirm"


def _magnitudes(wrench: FloatArray) -> tuple[float, float]:
    force, torque = np.linalg.norm(wrench.reshape(2, 3), axis=1).tolist()
    return force, torque


def format_millimetres(point: FloatArray) -> str:
    """A point (3,) [m] as text in whole millimetres, without the unit."""
    return "[" + ", ".join(str(round(1e3 * value)) for value in point) + "]"


def _format_shift(shift: FloatArray) -> str:
    return ", ".join(f"{axis} {round(1e3 * value):+d}" for axis, value in zip("XYZ", shift, strict=True)) + " mm"


def _format_pose(found: FloatArray) -> str:
    """A UR pose (6,) as the pendant shows it."""
    parts = [f"{axis} {round(1e3 * value, 1) + 0.0:.1f}" for axis, value in zip("XYZ", found[:3], strict=True)]
    turns = [f"R{axis} {round(value, 3) + 0.0:.3f}" for axis, value in zip("XYZ", found[3:], strict=True)]
    return f"{' '.join(parts)} mm, {' '.join(turns)} rad"

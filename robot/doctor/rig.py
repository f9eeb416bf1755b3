"""Checks of a rig of hardware before anything moves: network, versions, remote control, where the arms stand and what
they feel, cameras, limits.

Connects to the dashboard and to the RTDE port of each arm, and reads each camera for a second. It never becomes a
commander: no input register is claimed and no program is sent, so it may check an arm that another program drives.
"""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from robot.arm.dashboard import PORT as DASHBOARD
from robot.arm.dashboard import Dashboard
from robot.arm.rtde import PORT as RTDE
from robot.arm.rtde import read_controller
from robot.camera.camera import Camera
from robot.common import MOCK_SERIAL
from robot.common.kinematics import Kinematics
from robot.common.tcp import ArmFrames
from robot.doctor.machine import Check
from robot.doctor.stand import Stand, compare, keep_out, stand
from robot.errors import DeviceError
from robot.mock.cell.cell import MockCell
from tacsim import pose as se3
from tacsim.interface import Pose
from tacsim.models.hardware import CameraSensorConfig, UrArmConfig
from tacsim.models.rig import RigConfig

PORTS = {DASHBOARD: "dashboard", 30003: "script", RTDE: "RTDE"}
TIMEOUT = 2.0  # of each connection [s]
CAMERA_TIME = 1.0  # for which a camera is read [s]
MIN_POLYSCOPE = (5, 6)  # the first version that tells whether it is in remote control
MIN_FRAME_RATE = 0.8  # share of the rate asked for; a slower camera is a warning


def examine_rig(config: RigConfig, file: str | None = None) -> list[Check]:
    """All checks of one rig. Mocks that its file asks for are started for as long as it takes.

    file: what the rig is called on the command line, for the commands to be typed next.
    """
    arms = {name: arm for name, arm in config.arms.items() if isinstance(arm, UrArmConfig)}
    cameras = {name: sensor for name, sensor in config.sensors.items() if isinstance(sensor, CameraSensorConfig)}
    if not (arms or cameras):
        return [Check("rig", "ok", f"'{config.name}' has no hardware: nothing to check")]
    try:
        with MockCell(config) as cell:
            checks = examine_arms(config, cell.start_poses, file or config.name)
            checks += [_camera(name, camera) for name, camera in cameras.items()]
    except (DeviceError, ValueError, RuntimeError) as failure:
        return [Check("rig", "fail", str(failure), "mend the rig file")]
    return checks


def examine_arms(config: RigConfig, starts: Mapping[str, Pose], file: str) -> list[Check]:
    """The checks of its arms alone. starts: where the scene of a mock rig has them."""
    found = _Found(file, dict(starts), {})
    arms = {name: arm for name, arm in config.arms.items() if isinstance(arm, UrArmConfig)}
    return [*(check for name, arm in arms.items() for check in _arm(name, arm, found)), *_keep_outs(config, found)]


@dataclass(frozen=True, slots=True)
class _Found:
    """What the checks of one arm leave for others."""

    file: str
    starts: dict[str, Pose]  # where the scene of a mock rig says
    stands: dict[str, Stand]


def _keep_outs(config: RigConfig, found: _Found) -> Iterator[Check]:
    for pair in config.keep_out:
        first, second = ((name, found.stands.get(name)) for name in pair.arms)
        if first[1] is not None and second[1] is not None:
            yield keep_out((first[0], first[1]), (second[0], second[1]), pair.distance, found.file)


def _arm(name: str, config: UrArmConfig, found: _Found) -> Iterator[Check]:
    closed = [f"{port} ({what})" for port, what in PORTS.items() if not _open(config.host, port)]
    if closed:
        advice = "is the controller on, the address right, and the service allowed (Settings, Security, Services)?"
        yield Check(f"{name}: network", "fail", f"{config.host}: no answer at {', '.join(closed)}", advice)
        return
    yield Check(f"{name}: network", "ok", f"{config.host}: ports {', '.join(map(str, PORTS))} answer")
    try:
        with Dashboard(config.host, TIMEOUT) as dashboard:
            yield from _controller(name, config, dashboard)
    except DeviceError as failure:
        yield Check(f"{name}: dashboard", "fail", str(failure), "restart the controller, and look at its log")
    try:
        now = found.stands[name] = stand(config, read_controller(config.host, TIMEOUT))
    except DeviceError as failure:
        yield Check(f"{name}: RTDE", "fail", str(failure), "restart the controller")
    else:
        yield Check(f"{name}: RTDE", "ok", "version 2")
        start = found.starts.get(name) if config.start is None else config.start.pose
        yield from compare(name, config, now, start, found.file)
    yield _limits(name, config)
    yield _start(name, config)


def _open(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), TIMEOUT).close()
    except OSError:
        return False
    return True


def _controller(name: str, config: UrArmConfig, dashboard: Dashboard) -> Iterator[Check]:
    version = dashboard.ask("PolyscopeVersion")
    found = re.search(r"(\d+)\.(\d+)\.\d+", version)
    fit = found is not None and (int(found[1]), int(found[2])) >= MIN_POLYSCOPE
    lowest = ".".join(map(str, MIN_POLYSCOPE))
    advice = "" if fit else f"update PolyScope to {lowest} or later: older ones cannot be asked for remote control"
    yield Check(f"{name}: PolyScope", "ok" if fit else "warn", version, advice)
    model, serial = dashboard.model(), dashboard.serial()
    wrong = model is not None and not config.model.startswith(model)
    yield Check(
        f"{name}: model",
        "fail" if wrong else "ok",
        f"{(model or 'not told').upper()}, serial number {serial}",
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
        yield Check(f"{name}: ready", "fail", str(failure), "see to it at the pendant, then look again")


def _limits(name: str, config: UrArmConfig) -> Check:
    limits = config.limits
    size = 1e3 * (np.array(limits.workspace.upper) - limits.workspace.lower)
    words = (
        f"workspace {size[0]:.0f} x {size[1]:.0f} x {size[2]:.0f} mm, {len(limits.planes)} walls, "
        f"{1e3 * limits.speed:.0f} mm/s, {limits.acceleration:g} m/s², {limits.force:g} N, {limits.torque:g} N m"
    )
    advice = "these guard the work, not people: set the safety limits on the pendant too" if config.mock is None else ""
    return Check(f"{name}: limits", "ok", words, advice)


def _start(name: str, config: UrArmConfig) -> Check:
    """The start pose lies within the workspace and the reach."""
    label = f"{name}: start"
    if config.start is None:
        if config.mock is not None:
            return Check(label, "ok", "where the scene says")
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


def _camera(name: str, config: CameraSensorConfig) -> Check:
    label = f"{name}: camera"
    try:
        with Camera(config, name, TIMEOUT + 1.0) as camera:
            time.sleep(CAMERA_TIME)
            status = camera.status
    except DeviceError as failure:
        return Check(label, "fail", str(failure), "see cable, address, and what else uses the camera")
    fps, age = status.fps or 0.0, status.age or 0.0
    words = (
        f"{config.width} x {config.height} px, {fps:.1f} frames/s, newest {1e3 * age:.0f} ms old, "
        f"{status.dropped} lost, {status.damaged} damaged, {status.repeated} shown again"
    )
    if status.error is not None and age > config.max_age:
        return Check(label, "fail", words, status.error)
    if fps < MIN_FRAME_RATE * config.fps or status.damaged > 1:  # the first after opening is often damaged
        return Check(label, "warn", words, f"{config.fps:g} frames/s were asked for: exposure, USB hub, or cable?")
    return Check(label, "ok", words)

"""The process that talks to one UR arm: `python -m robot.arm.worker`, with its WorkerConfig as JSON on stdin.

The only importer of ur_rtde, in a process of its own because the library may crash, hang, or hold the interpreter's
lock while it waits for a silent controller. It cannot reconnect (robot.arm.confinement): a worker that has lost its
connection ends, and the driver starts another one. For a real arm it asks for real-time priority, and runs on without
it.

The loop, every 2 ms, in this order: read the newest package and publish it; end if the driver or the connection is
gone; check safety bits, force, region, other arms and gels, and publish a fault before anything that may block; read
the newest command; compute the next servo target and send it.
"""

from __future__ import annotations

import contextlib
import gc
import os
import socket
import time
import traceback
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

import numpy as np

from robot.arm.channel import STATE, WINDOW, Channel, WorkerConfig
from robot.arm.confinement import TimeLimit, allow_time_limits, last_connections
from robot.arm.controller.dashboard import Dashboard
from robot.arm.servo import Servo
from robot.arm.shared_ring import Segment
from robot.arm.start_servo import StartServo
from robot.arm.status import ArmStatus, is_healthy
from robot.arm.trajectory import PERIOD
from robot.common.kinematics import Kinematics, displacement, matrix
from robot.common.process import Lifeline, Parent
from robot.common.realtime import WORKER, ask_for_realtime
from robot.errors import DeviceBusyError, DeviceError, DeviceNotConnectedError
from tacsim.interface import FloatArray

PORTS = {30004: "RTDE", 30003: "script"}
VARIABLES = [  # of one package; a name that the library does not know would shift the others
    "timestamp",
    "actual_q",
    "actual_qd",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "actual_TCP_force",
    "target_q",
    "target_qd",
    "speed_scaling",
    "target_speed_fraction",
    "runtime_state",
    "safety_status_bits",
]
END_TIMEOUT = 3.0  # longest time to end the program; the driver waits less, but it may be gone [s]
MAX_BLIND_PERIODS = 5  # periods without a new package; then nothing is sent
FAILED_STATUS = 3  # exit status; the reason is on stdout, as JSON


class Worker:
    """One connection, from the first probe to the last servo call."""

    def __init__(self, config: WorkerConfig) -> None:
        margin = 10e-3  # a call in the loop takes at most so much longer than link_timeout: the driver tells then [s]
        self.config = config
        self.frames = config.frames
        self.channel = Channel(Segment(config.segment))
        self.record = np.zeros((), STATE)
        self.record["top_speed"] = config.speed
        self.partners = [Channel(Segment(partner.segment)) for partner in config.partners]
        servo = Servo if config.way is None else StartServo
        self.servo = servo(config, commands_read=self.channel.commands.count, tactile_read=self.channel.tactile.count)
        self._periods = np.full(WINDOW, PERIOD)
        self._limit = TimeLimit(config.link_timeout + margin)  # of calls into the library
        self._driver = Lifeline(config.parent)  # opens a file: not once it is connected
        self._last = 0.0  # when the last period ended
        self._rereads = 0  # of the same package
        self._refused = 0  # periods since the controller refused a command; 0: it did not
        self.state = self.frames.measure(self.record)
        self.scaling, self.target, self.target_speeds = 1.0, np.zeros(6), np.zeros(6)  # of the newest package
        self._publish(ArmStatus.CONNECTING)

    # -- connecting ----------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Raises a DeviceError that says what is wrong. Blocks if the controller falls silent half way: the driver
        kills the process then."""
        probe_timeout = 2.0  # of a TCP connection [s]
        config = self.config
        for port, what in PORTS.items():
            try:
                socket.create_connection((config.host, port), probe_timeout).close()
            except OSError as failure:
                raise DeviceNotConnectedError(
                    f"no controller at {config.host}: port {port} ({what}): {failure}; is it on, and the address right?"
                ) from failure
        with Dashboard(config.host, probe_timeout) as dashboard:
            dashboard.require_identity(config.name, config.model, config.serial, config.refused_serial)
            dashboard.require_ready(f"arm '{config.name}'")
        try:
            import rtde_control
            import rtde_receive
        except ImportError as failure:
            raise DeviceNotConnectedError(
                f"arm '{config.name}' needs ur_rtde, which has no wheel for this Python ({failure}); use Python "
                "3.11 or 3.12 on x86-64 Linux"
            ) from failure
        try:
            with last_connections():
                self.receive: Any = rtde_receive.RTDEReceiveInterface(config.host, 500.0, VARIABLES)
                self.control: Any = rtde_control.RTDEControlInterface(config.host, 500.0)
        except Exception as failure:  # the library raises RuntimeError for everything
            if "in use" in str(failure).lower():
                raise DeviceBusyError(
                    f"arm '{config.name}' at {config.host} is controlled by another program; end that one first"
                ) from failure
            raise DeviceNotConnectedError(f"arm '{config.name}' at {config.host}: {failure}") from failure
        try:
            self._set_up()
        except DeviceError:
            if self._read() or time.monotonic() - float(self.record["time"]) < config.link_timeout:  # it answers
                with TimeLimit(END_TIMEOUT), contextlib.suppress(RuntimeError):
                    self.control.stopScript()
            raise

    def _set_up(self) -> None:
        """Changes what the controller keeps (TCP, payload) only when the model is known to be the right one."""
        config, control = self.config, self.control
        try:
            self._check_model(lambda: matrix(control.getTCPOffset()), "model")
            self._set("the TCP", control.setTcp, config.tcp)
            self._set("the payload", control.setPayload, config.mass, config.mass_centre)
            self._await_change()
            self._check_model(lambda: self.frames.flange_from_tool, "model and flange_from_tool")
            self._set("the watchdog", control.setWatchdog, config.watchdog)
        except RuntimeError as failure:
            if isinstance(failure, DeviceError):
                raise
            raise DeviceNotConnectedError(
                f"arm '{config.name}': the controller at {config.host} closed the connection; look why, then try again"
            ) from failure

    def _set(self, what: str, method: Any, *arguments: Any) -> None:
        if not method(*arguments):
            raise DeviceNotConnectedError(f"arm '{self.config.name}': the controller did not take {what} {arguments}")

    def _await_change(self) -> None:
        """Reads until a package is measured after what was set last. The answer to that comes by another connection
        than the packages do: the next of these may be older, and show the weight of a payload untold."""
        change_timeout = 5.0  # longest wait for such a package [s]
        # what is measured so long after a new TCP or payload is by it, on the controller's clock [s]
        settling_time = 0.2
        begin, deadline = float(self.record["stamp"]), time.monotonic() + change_timeout
        while not (self._read() and not 0.0 <= float(self.record["stamp"]) - begin < settling_time):
            if time.monotonic() > deadline:
                raise DeviceNotConnectedError(
                    f"arm '{self.config.name}': no RTDE package arrived that was measured after its payload was set"
                )
            time.sleep(PERIOD)

    def _check_model(self, tool: Callable[[], FloatArray], advice: str) -> None:
        """Raises unless the controller's pose agrees with the forward kinematics of the model and of `tool`, which
        gives flange_from_tool (4, 4)."""
        max_distance, max_angle = 20e-3, 0.05  # FK of the named model and the controller's pose agree within [m, rad]
        kinematics = Kinematics(self.config.model)  # type: ignore[arg-type]  # a Model, from JSON
        found, deadline = "no RTDE package with a pose arrived within 1 s", time.monotonic() + 1.0
        while True:
            if self._read():
                expected = kinematics.forward(self.record["joints"], tool())
                difference = displacement(expected, matrix(self.record["tcp_pose"]))
                shift, turn = float(np.linalg.norm(difference[:3])), float(np.linalg.norm(difference[3:]))
                if shift <= max_distance and turn <= max_angle:
                    return
                found = (
                    f"its tool is {1e3 * shift:.0f} mm and {turn:.2f} rad from where a {self.config.model} would "
                    f"have it; check {advice}"
                )
            if time.monotonic() > deadline:
                raise DeviceNotConnectedError(f"arm '{self.config.name}': {found}")
            time.sleep(PERIOD)

    # -- the loop ------------------------------------------------------------------------------------------------

    def run(self, parent: Parent) -> NoReturn:
        """Runs until the driver closes, or driver or connection is gone; tells `parent` of the first status."""
        grace_periods = 5  # periods in which a package may say why the controller takes no more commands
        parentless_timeout = 0.5  # longest braking when the driver is gone [s]
        close_timeout = 0.6  # longest braking when the driver closes [s]
        gc.freeze()  # keeps what is loaded out of collections in the middle of a period
        self._last = time.monotonic()
        deadline = self._last + PERIOD
        ending: float | None = None  # when the last braking is cut off
        while True:
            with self._limit:
                self._rereads = 0 if self._read() else self._rereads + 1
                connected = self.receive.isConnected() and self.control.isConnected()
            self._publish(self.servo.status)
            orphan = self._driver.cut()
            now = time.monotonic()
            # Periods count, not time: a process that was suspended reads again first, packages may be waiting.
            blind = self._rereads > MAX_BLIND_PERIODS
            if not connected or (blind and now - float(self.record["time"]) > self.config.link_timeout):
                self._lose_link()
            partners = self._read_partners(now)
            before = self.servo.status
            stopped = self._controller_stop()
            if stopped is None and self._refused > grace_periods:
                stopped = ArmStatus.PROGRAM_STOPPED
            if stopped is not None:
                self.servo.trip(stopped)
            command = self.channel.commands.newest()  # before the report: what was seen when it was decided counts
            self.servo.on_scaling(self.scaling)
            self.servo.check_faults(self.state, partners)
            if self._rereads == 0:
                self.servo.check_following(self.state, self.target, self.target_speeds)
            self.servo.on_tactile(*self.channel.tactile.newest())
            if self.servo.status != before:
                self._publish(self.servo.status)
                if before == ArmStatus.CONNECTING:
                    with contextlib.suppress(BrokenPipeError):  # the driver has died: the next period sees it
                        parent.send({"connected": True})
            self.servo.on_command(*command)
            if ending is None and (orphan or self.servo.close_requested):
                ending = now + (parentless_timeout if orphan else close_timeout)
                if orphan:
                    self.servo.trip(ArmStatus.CLOSED)
            if stopped is not None or self.servo.status.is_controller_stop:
                if ending is not None:
                    self._leave()
            else:
                if not blind:
                    self._act(partners)
                if ending is not None and (self.servo.resting or now > ending):
                    self._end_program()
                    self._leave()
            deadline = self._sleep(deadline)

    def _act(self, partners: list[Any]) -> None:
        max_target_age = 5e-3  # a target that took this long was held up with its process, and comes too late [s]
        if self._refused:  # the next packages say why
            self._refused += 1
            return
        now = time.monotonic()
        joints = self.servo.step(now, self.state, partners)
        if time.monotonic() - now > max_target_age:
            joints = self.servo.withdraw()
        config, control = self.config, self.control
        with self._limit, self._lost_link():
            if joints is None:
                alive = control.kickWatchdog()
            else:
                alive = control.servoJ(joints.tolist(), 0.0, 0.0, PERIOD, config.lookahead, config.gain)
        if not alive:
            self._refused = 1
        elif self.servo.zero_due(now):
            self._zero_wrench()

    def _zero_wrench(self) -> None:
        zero_timeout = 2.0  # longest time to zero the force sensor [s]
        self.record["busy_until"] = time.monotonic() + zero_timeout
        self._publish(self.servo.status)
        with TimeLimit(zero_timeout), self._lost_link():
            if self.control.zeroFtSensor():
                self.record["zeroed"] += 1
        self.record["busy_until"] = 0.0

    def _read(self) -> bool:
        """Reads the newest package into the record; True if it is new. All fields are of one package: its time stamp is
        the same before and after. A package with a NaN or an infinity is ignored."""
        receive, record = self.receive, self.record
        while True:
            stamp = receive.getTimestamp()
            fields = (
                receive.getActualQ(),
                receive.getActualQd(),
                receive.getActualTCPPose(),
                receive.getActualTCPSpeed(),
                receive.getActualTCPForce(),
            )
            target, target_speeds = receive.getTargetQ(), receive.getTargetQd()
            scaling = receive.getSpeedScaling() * receive.getTargetSpeedFraction()  # limiter, slider on the pendant
            bits = receive.getRuntimeState(), receive.getSafetyStatusBits()
            if receive.getTimestamp() == stamp:
                break
        if stamp == float(record["stamp"]) or not np.isfinite([*fields, target, target_speeds, [scaling] * 6]).all():
            return False
        self.scaling, self.target, self.target_speeds = scaling, np.array(target), np.array(target_speeds)
        record["joints"], record["joint_speeds"], record["tcp_pose"], record["tcp_speed"], record["tcp_force"] = fields
        record["stamp"], record["time"] = stamp, time.monotonic()
        self.state = self.frames.measure(record)
        record["position"] = self.state.sensor[:3, 3]
        record["runtime_state"], record["safety_bits"] = bits
        return True

    def _controller_stop(self) -> ArmStatus | None:
        # recovery, safeguard, emergency stops, fault
        stop_bits = 1 << 3 | 1 << 4 | 1 << 5 | 1 << 6 | 1 << 7 | 1 << 8 | 1 << 9
        protective_bit = 1 << 2
        playing = 2  # of runtime_state
        runtime, bits = int(self.record["runtime_state"]), int(self.record["safety_bits"])
        if bits & stop_bits:
            return ArmStatus.EMERGENCY_STOP
        if bits & protective_bit:
            return ArmStatus.PROTECTIVE_STOP
        return None if runtime == playing else ArmStatus.PROGRAM_STOPPED

    def _read_partners(self, now: float) -> list[Any]:
        """The newest record of each other arm; None where it is missing, too old, or not healthy."""
        seen: list[Any] = []
        for partner in self.partners:
            record = partner.states.latest()
            if record is not None and now - float(record["written"]) > self.config.link_timeout:
                record = None
            seen.append(record if is_healthy(record) else None)
        return seen

    def _publish(self, status: ArmStatus) -> None:
        record, servo = self.record, self.servo
        record["written"], record["status"], record["resting"] = time.monotonic(), status, servo.resting
        record["commands_read"], record["rejected"], record["shortened"] = (
            servo.commands_read,
            servo.rejected,
            servo.shortened,
        )
        record["target"] = record["position"] if servo.motion is None else servo.motion.position
        record["stopping_point"] = record["position"] if servo.stop is None else servo.stop
        self.channel.states.write(record)

    def _sleep(self, deadline: float) -> float:
        """Sleeps until the absolute deadline and returns the next one. Missed periods are skipped, and counted."""
        record, cycle = self.record, int(self.record["cycles"])
        late = time.monotonic() - deadline
        if late < 0.0:
            time.sleep(-late)
        elif late > PERIOD:
            record["overruns"] += int(late / PERIOD)
            deadline += late
        beat = time.monotonic()
        self._periods[cycle % WINDOW] = beat - self._last
        self._last = beat
        record["cycles"] = cycle + 1
        record["late"], record["longest"] = np.count_nonzero(self._periods >= 2.0 * PERIOD), self._periods.max()
        if cycle % WINDOW == WINDOW - 1:
            record["period"] = np.sort(self._periods)[[WINDOW // 2, WINDOW * 99 // 100, -1]]
        return deadline + PERIOD

    # -- ending --------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _lost_link(self) -> Iterator[None]:
        """What the library raises inside is that it has lost its connection and cannot have another."""
        try:
            yield
        except RuntimeError:
            self._lose_link()

    def _lose_link(self) -> NoReturn:
        self._publish(ArmStatus.LINK_LOST)
        self._leave()

    def _end_program(self) -> None:
        """Both calls block on the controller; the driver kills a worker that takes too long."""
        with TimeLimit(END_TIMEOUT), self._lost_link():
            if self.servo.motion is not None:
                self.control.servoStop(10.0)
            self.control.stopScript()

    def _leave(self) -> NoReturn:
        """Ends the process without the library's destructors, which may wait for an answer that never comes."""
        os._exit(0)


def main() -> NoReturn:
    connect_timeout = 60.0  # longest time to connect; the driver waits less, but it may be gone [s]
    parent = Parent()  # the library prints
    allow_time_limits()
    config = WorkerConfig.of(parent.receive())
    realtime = config.realtime and ask_for_realtime(WORKER)  # before the library starts its threads
    try:
        worker = Worker(config)
        worker.record["realtime"] = realtime
        with TimeLimit(connect_timeout):
            worker.connect()
    except (DeviceError, OSError) as failure:
        kind = type(failure) if isinstance(failure, DeviceError) else DeviceNotConnectedError
        with contextlib.suppress(BrokenPipeError):  # the driver has died
            parent.send({"error": str(failure), "kind": kind.__name__})
        os._exit(FAILED_STATUS)
    try:
        worker.run(parent)
    except BaseException:  # not to the interpreter's end, where the library's destructors wait
        traceback.print_exc()
        os._exit(FAILED_STATUS)


if __name__ == "__main__":
    main()

"""The process that talks to one UR arm: `python -m robot.arm.worker`, with its WorkerConfig as JSON on stdin.

The only importer of ur_rtde, in its own process because the library may crash, hang, or hold the interpreter lock
while it waits for a controller that does not answer. It cannot reconnect (robot.arm.confinement): a worker that has
lost its connection ends, and the driver starts another one. For a real arm it requests real-time priority, and runs
without it if refused.

The loop, every 2 ms, in this order: read the newest package and publish it; end if the driver has ended or the
connection is lost; check safety bits, force, region, other arms and gels, and publish a fault before any call that may
block; read the newest command; compute the next servo target and send it.
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

from robot.arm.channel import STATE, STATISTICS_PERIODS, Channel, Segment, WorkerConfig
from robot.arm.confinement import TimeLimit, enable_time_limits, forbid_later_connections
from robot.arm.connections import Dashboard
from robot.arm.servo import Servo
from robot.arm.start_servo import StartServo
from robot.arm.status import ArmStatus, is_healthy
from robot.arm.trajectory import PERIOD
from robot.common import WORKER_PRIORITY, request_realtime
from robot.common.kinematics import Kinematics, displacement, matrix
from robot.common.process import Parent, ParentMonitor
from robot.errors import DeviceBusyError, DeviceError, DeviceNotConnectedError
from tacsim.interface import FloatArray

PORTS = {30004: "RTDE", 30003: "script"}
VARIABLES = [  # of one package; an unknown name would shift the others
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
MAX_ENDING_TIME = 3.0  # of the program; the driver waits less, but it may have ended [s]
MAX_MISSED_PACKAGES = 5  # periods without a new package; beyond it nothing is sent
FAILED_EXIT_STATUS = 3  # the reason is on stdout, as JSON


class Worker:
    """One connection, from the first probe to the last servo call."""

    def __init__(self, config: WorkerConfig) -> None:
        margin = 10e-3  # a call in the loop may exceed link_timeout by this; the driver reports it [s]
        self.config = config
        self.frames = config.frames
        self.channel = Channel(Segment(config.segment))
        self.record = np.zeros((), STATE)
        self.record["top_speed"] = config.speed
        self.partners = [Channel(Segment(partner.segment)) for partner in config.partners]
        servo = Servo if config.start_path is None else StartServo
        self.servo = servo(config, commands_read=self.channel.commands.count, tactile_read=self.channel.tactile.count)
        self._periods = np.full(STATISTICS_PERIODS, PERIOD)
        self._call_limit = TimeLimit(config.link_timeout + margin)  # for calls into the library
        self._driver = ParentMonitor(config.parent)  # opens a file, which is impossible after connecting
        self._last_period_end = 0.0  # [s]
        self._rereads = 0  # reads of the same package
        self._refused_periods = 0  # since the controller refused a command; 0: not refused
        self.state = self.frames.measure(self.record)
        self.scaling, self.controller_target, self.controller_target_speeds = (
            1.0,
            np.zeros(6),
            np.zeros(6),
        )  # of the newest package
        self._publish(ArmStatus.CONNECTING)

    # -- connecting ----------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Connects to the controller. Raises a DeviceError with the cause. Blocks if the controller stops answering;
        the driver then kills the process."""
        probe_timeout = 2.0  # of a TCP connection [s]
        config = self.config
        for port, what in PORTS.items():
            try:
                socket.create_connection((config.host, port), probe_timeout).close()
            except OSError as failure:
                raise DeviceNotConnectedError(
                    f"no controller at {config.host}: port {port} ({what}): {failure}; is it on, is the address right?"
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
            with forbid_later_connections():
                self.receive: Any = rtde_receive.RTDEReceiveInterface(config.host, 500.0, VARIABLES)
                self.control: Any = rtde_control.RTDEControlInterface(config.host, 500.0)
        except Exception as failure:  # the library raises RuntimeError for everything
            if "in use" in str(failure).lower():
                raise DeviceBusyError(
                    f"arm '{config.name}' at {config.host} is controlled by another program; end that program first"
                ) from failure
            raise DeviceNotConnectedError(f"arm '{config.name}' at {config.host}: {failure}") from failure
        try:
            self._configure_controller()
        except DeviceError:
            # stops the script of a controller that still answers
            if self._read_package() or time.monotonic() - float(self.record["time"]) < config.link_timeout:
                with TimeLimit(MAX_ENDING_TIME), contextlib.suppress(RuntimeError):
                    self.control.stopScript()
            raise

    def _configure_controller(self) -> None:
        """Sets TCP and payload of the controller, which keeps them, only after the model has been checked."""
        config, control = self.config, self.control
        try:
            self._check_model(lambda: matrix(control.getTCPOffset()), "model")
            self._apply_setting("the TCP", control.setTcp, config.tcp)
            self._apply_setting("the payload", control.setPayload, config.mass, config.mass_centre)
            self._wait_for_settings()
            self._check_model(lambda: self.frames.flange_from_tool, "model and flange_from_tool")
            self._apply_setting("the watchdog", control.setWatchdog, config.watchdog)
        except RuntimeError as failure:
            if isinstance(failure, DeviceError):
                raise
            raise DeviceNotConnectedError(
                f"arm '{config.name}': the controller at {config.host} closed the connection; find out why, then retry"
            ) from failure

    def _apply_setting(self, what: str, method: Any, *arguments: Any) -> None:
        if not method(*arguments):
            raise DeviceNotConnectedError(f"arm '{self.config.name}': the controller did not take {what} {arguments}")

    def _wait_for_settings(self) -> None:
        """Reads until a package is measured after the last setting. The answer to a setting and the packages come by
        different connections: the next package may be older, with forces for the former payload."""
        change_timeout = 5.0  # for such a package [s]
        settling_time = 0.2  # after it, on the controller's clock, packages use a new TCP or payload [s]
        begin, deadline = float(self.record["stamp"]), time.monotonic() + change_timeout
        while not (self._read_package() and not 0.0 <= float(self.record["stamp"]) - begin < settling_time):
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
            if self._read_package():
                expected = kinematics.forward(self.record["joints"], tool())
                difference = displacement(expected, matrix(self.record["tcp_pose"]))
                shift, turn = float(np.linalg.norm(difference[:3])), float(np.linalg.norm(difference[3:]))
                if shift <= max_distance and turn <= max_angle:
                    return
                found = (
                    f"its tool is {1e3 * shift:.0f} mm and {turn:.2f} rad from the pose of a {self.config.model} at "
                    f"these joints; check {advice}"
                )
            if time.monotonic() > deadline:
                raise DeviceNotConnectedError(f"arm '{self.config.name}': {found}")
            time.sleep(PERIOD)

    # -- the loop ------------------------------------------------------------------------------------------------

    def run(self, parent: Parent) -> NoReturn:
        """Runs until the driver closes or ends, or the connection is lost; reports the first status to `parent`."""
        report_periods = 5  # periods in which a package may report why the controller refuses commands
        parentless_timeout = 0.5  # of braking when the driver has ended [s]
        close_timeout = 0.6  # of braking when the driver closes [s]
        gc.freeze()  # a collection in a period does not scan the loaded modules
        self._last_period_end = time.monotonic()
        deadline = self._last_period_end + PERIOD
        exit_deadline: float | None = None  # latest end of the last braking [s]
        while True:
            with self._call_limit:
                self._rereads = 0 if self._read_package() else self._rereads + 1
                connected = self.receive.isConnected() and self.control.isConnected()
            self._publish(self.servo.status)
            is_orphan = self._driver.is_parent_gone()
            now = time.monotonic()
            # Counts periods, not time: after a suspension, packages may be waiting to be read.
            is_blind = self._rereads > MAX_MISSED_PACKAGES
            if not connected or (is_blind and now - float(self.record["time"]) > self.config.link_timeout):
                self._end_with_lost_link()
            partners = self._read_partners(now)
            status_before = self.servo.status
            stop_status = self._controller_stop()
            if stop_status is None and self._refused_periods > report_periods:
                stop_status = ArmStatus.PROGRAM_STOPPED
            if stop_status is not None:
                self.servo.enter_fault(stop_status)
            command = self.channel.commands.newest()  # read before the report, so the report is not older
            self.servo.on_speed_scaling(self.scaling)
            self.servo.check_faults(self.state, partners)
            if self._rereads == 0:
                self.servo.check_following(self.state, self.controller_target, self.controller_target_speeds)
            self.servo.on_tactile(*self.channel.tactile.newest())
            if self.servo.status != status_before:
                self._publish(self.servo.status)
                if status_before == ArmStatus.CONNECTING:
                    with contextlib.suppress(BrokenPipeError):  # the driver has ended: the next period detects it
                        parent.send({"connected": True})
            self.servo.on_command(*command)
            if exit_deadline is None and (is_orphan or self.servo.close_requested):
                exit_deadline = now + (parentless_timeout if is_orphan else close_timeout)
                if is_orphan:
                    self.servo.enter_fault(ArmStatus.CLOSED)
            if stop_status is not None or self.servo.status.is_controller_stop:
                if exit_deadline is not None:
                    self._exit_process()
            else:
                if not is_blind:
                    self._send_step(partners)
                if exit_deadline is not None and (self.servo.is_at_rest or now > exit_deadline):
                    self._end_program()
                    self._exit_process()
            deadline = self._sleep_until(deadline)

    def _send_step(self, partners: list[Any]) -> None:
        max_target_age = 5e-3  # of computing; a later target comes from a suspended process and is not sent [s]
        if self._refused_periods:  # the next packages report why
            self._refused_periods += 1
            return
        now = time.monotonic()
        joints = self.servo.step(now, self.state, partners)
        if time.monotonic() - now > max_target_age:
            joints = self.servo.undo_last_step()
        config, control = self.config, self.control
        with self._call_limit, self._ending_on_lost_link():
            if joints is None:
                is_accepted = control.kickWatchdog()
            else:
                is_accepted = control.servoJ(joints.tolist(), 0.0, 0.0, PERIOD, config.lookahead, config.gain)
        if not is_accepted:
            self._refused_periods = 1
        elif self.servo.take_zero_request(now):
            self._zero_wrench()

    def _zero_wrench(self) -> None:
        zero_timeout = 2.0  # of the force sensor [s]
        self.record["busy_until"] = time.monotonic() + zero_timeout
        self._publish(self.servo.status)
        with TimeLimit(zero_timeout), self._ending_on_lost_link():
            if self.control.zeroFtSensor():
                self.record["zeroed"] += 1
        self.record["busy_until"] = 0.0

    def _read_package(self) -> bool:
        """Reads the newest package into the record. True if it is new. All fields are of one package: its time stamp is
        the same before and after reading. A package with a NaN or an infinity is ignored."""
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
        self.scaling = scaling
        self.controller_target, self.controller_target_speeds = np.array(target), np.array(target_speeds)
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
        records: list[Any] = []
        for partner in self.partners:
            record = partner.states.latest()
            if record is not None and now - float(record["written"]) > self.config.link_timeout:
                record = None
            records.append(record if is_healthy(record) else None)
        return records

    def _publish(self, status: ArmStatus) -> None:
        record, servo = self.record, self.servo
        record["written"], record["status"], record["resting"] = time.monotonic(), status, servo.is_at_rest
        counts = servo.commands_read, servo.rejected, servo.clipped
        record["commands_read"], record["rejected"], record["clipped"] = counts
        record["target"] = record["position"] if servo.motion is None else servo.motion.position
        record["stopping_point"] = record["position"] if servo.stopping_point is None else servo.stopping_point
        self.channel.states.write(record)

    def _sleep_until(self, deadline: float) -> float:
        """Sleeps until `deadline` and returns the next one. Missed periods are skipped and counted."""
        record, cycle = self.record, int(self.record["cycles"])
        late = time.monotonic() - deadline
        if late < 0.0:
            time.sleep(-late)
        elif late > PERIOD:
            record["overruns"] += int(late / PERIOD)
            deadline += late
        period_end = time.monotonic()
        self._periods[cycle % STATISTICS_PERIODS] = period_end - self._last_period_end
        self._last_period_end = period_end
        record["cycles"] = cycle + 1
        record["late"], record["longest"] = np.count_nonzero(self._periods >= 2.0 * PERIOD), self._periods.max()
        if cycle % STATISTICS_PERIODS == STATISTICS_PERIODS - 1:
            record["period"] = np.sort(self._periods)[[STATISTICS_PERIODS // 2, STATISTICS_PERIODS * 99 // 100, -1]]
        return deadline + PERIOD

    # -- ending --------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _ending_on_lost_link(self) -> Iterator[None]:
        """Ends the worker with LINK_LOST if the library raises: it has lost its connection and cannot reconnect."""
        try:
            yield
        except RuntimeError:
            self._end_with_lost_link()

    def _end_with_lost_link(self) -> NoReturn:
        self._publish(ArmStatus.LINK_LOST)
        self._exit_process()

    def _end_program(self) -> None:
        """Stops the motion and the program. Both calls wait for the controller; the driver kills a slow worker."""
        with TimeLimit(MAX_ENDING_TIME), self._ending_on_lost_link():
            if self.servo.motion is not None:
                self.control.servoStop(10.0)
            self.control.stopScript()

    def _exit_process(self) -> NoReturn:
        """Ends the process without the library's destructors, which may wait for an answer forever."""
        os._exit(0)


def main() -> NoReturn:
    connect_timeout = 60.0  # the driver waits less, but it may have ended [s]
    parent = Parent()  # the library prints
    enable_time_limits()
    config = WorkerConfig.from_dict(parent.receive())
    realtime = config.realtime and request_realtime(WORKER_PRIORITY)  # before the library starts its threads
    try:
        worker = Worker(config)
        worker.record["realtime"] = realtime
        with TimeLimit(connect_timeout):
            worker.connect()
    except (DeviceError, OSError) as failure:
        kind = type(failure) if isinstance(failure, DeviceError) else DeviceNotConnectedError
        with contextlib.suppress(BrokenPipeError):  # the driver has ended
            parent.send({"error": str(failure), "kind": kind.__name__})
        os._exit(FAILED_EXIT_STATUS)
    try:
        worker.run(parent)
    except BaseException:  # without the library's destructors, which may block
        traceback.print_exc()
        os._exit(FAILED_EXIT_STATUS)


if __name__ == "__main__":
    main()

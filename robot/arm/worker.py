"""The process that talks to one UR arm: `python -m robot.arm.worker`, started by robot.arm.ur with orders on its stdin.

The only importer of ur_rtde, and for that reason a process of its own: the library may crash, hang, or hold the
interpreter's lock while it waits for a silent controller. It is never asked to reconnect; a worker that lost its link
ends, and another one is started. For a real arm it asks for real-time priority, and runs on without.

The loop, each 2 ms and in this order: read the newest package as one snapshot, publish it; is the driver alive; is the
package fresh; safety bits, force, gels; a fault is published before anything that may wait; the newest command; limits,
trajectory, walls, other arms, reach; the servo call.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import signal
import socket
import sys
import time
from typing import Any, NoReturn

import numpy as np

from robot.arm import shared_ring
from robot.arm.channel import STATE, ArmStatus, Link, Orders
from robot.arm.dashboard import Dashboard
from robot.arm.servo import Servo, frames_of, measured, well
from robot.arm.trajectory import PERIOD
from robot.common.kinematics import Kinematics, motion
from robot.common.realtime import WORKER, ask_for_realtime
from robot.errors import DeviceBusyError, DeviceError, DeviceNotConnectedError

PORTS = {30004: "RTDE", 30003: "script"}
PROBE_TIMEOUT = 2.0  # of a TCP connection [s]
VARIABLES = [  # one package; every name is in the library's own table (any other would shift the rest)
    "timestamp",
    "actual_q",
    "actual_qd",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "actual_TCP_force",
    "runtime_state",
    "safety_status_bits",
]
PLAYING = 2  # of runtime_state
PROTECTIVE_BIT = 1 << 2
STOP_BITS = 1 << 3 | 1 << 4 | 1 << 5 | 1 << 6 | 1 << 7 | 1 << 8 | 1 << 9  # recovery, safeguard, e-stops, fault
MODEL_LENGTH, MODEL_TURN = 20e-3, 0.05  # FK of the named model and the controller's pose agree within [m, rad]
CLOSING = 0.6  # longest ramp when the driver closes [s]
PARENTLESS = 0.5  # the same when it is gone [s]
LIBRARY_PATIENCE = 4.5  # after so long the library gives a call up by itself [s]
STUCK = 10.0  # after so long without a period the process is ended: the library may wait for ever [s]
ORPHANED = 3.0  # the same when nobody is there who could kill it [s]
GRACE = 5  # periods in which a package may tell why the controller takes no more commands
FAILED = 3  # exit status: the reason stands on stdout as JSON
WINDOW = 500  # periods in the statistics


class Worker:
    """One connection, from the first probe to the last servo call."""

    def __init__(self, orders: Orders) -> None:
        self.orders = orders
        self.frames = frames_of(orders)
        self.segment = shared_ring.attach(orders.segment)
        self.link = Link(self.segment)
        self.record = np.zeros((), STATE)
        self.record["top_speed"] = orders.speed
        self.partners: list[Link | None] = [None] * len(orders.partners)
        self.servo = Servo(orders, taken=self.link.commands.count, touches=self.link.touches.count)
        self._periods = np.full(WINDOW, PERIOD)
        self._last = 0.0  # when the last period ended
        self._looks = 0  # at one package
        self._refused = 0  # periods since the controller took no more commands
        self._words = (0, 0)  # runtime_state, safety_status_bits
        self.state = measured(self.record, self.frames)
        self._publish(ArmStatus.CONNECTING)

    # -- connecting ----------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Raises a DeviceError that says what is wrong; a controller that falls silent half way holds it for ever, and
        the driver kills the process."""
        orders = self.orders
        for port, what in PORTS.items():
            try:
                socket.create_connection((orders.host, port), PROBE_TIMEOUT).close()
            except OSError as failure:
                raise DeviceNotConnectedError(
                    f"no controller at {orders.host}: port {port} ({what}): {failure}; is it on, and the address right?"
                ) from failure
        with Dashboard(orders.host, PROBE_TIMEOUT) as dashboard:
            self._check_identity(dashboard)
            dashboard.require_ready(f"arm '{orders.name}'")
        try:
            import rtde_control
            import rtde_receive
        except ImportError as failure:
            raise DeviceNotConnectedError(
                f"arm '{orders.name}' needs ur_rtde, which has no wheel for this Python ({failure}); use Python "
                "3.11 or 3.12 on x86-64 Linux or Windows"
            ) from failure
        try:
            self.receive: Any = rtde_receive.RTDEReceiveInterface(orders.host, 500.0, VARIABLES)
            self.control: Any = rtde_control.RTDEControlInterface(orders.host, 500.0)
        except Exception as failure:  # the library raises RuntimeError for all that can happen
            if "in use" in str(failure).lower():
                raise DeviceBusyError(
                    f"arm '{orders.name}' at {orders.host} is controlled by another program; end that one first"
                ) from failure
            raise DeviceNotConnectedError(f"arm '{orders.name}' at {orders.host}: {failure}") from failure
        self._call("the watchdog", self.control.setWatchdog, orders.watchdog)
        self._call("the TCP", self.control.setTcp, orders.tcp)
        self._call("the payload", self.control.setPayload, orders.mass, orders.mass_centre)
        self._check_model()

    def _check_identity(self, dashboard: Dashboard) -> None:
        orders = self.orders
        if dashboard.serial() == orders.refused_serial:
            raise DeviceNotConnectedError(
                f"{orders.host} is a mock controller, but arm '{orders.name}' has no `mock:` block"
            )
        model = dashboard.model()
        if model is not None and not orders.model.startswith(model):
            raise DeviceNotConnectedError(
                f"arm '{orders.name}' is a {model.upper()}, but its file says model: {orders.model}"
            )

    def _call(self, what: str, method: Any, *arguments: Any) -> None:
        if not method(*arguments):
            raise DeviceNotConnectedError(f"arm '{self.orders.name}': the controller did not take {what} {arguments}")

    def _check_model(self) -> None:
        """The controller's pose at these joints is the one that the model and the TCP give."""
        kinematics = Kinematics(self.orders.model)  # type: ignore[arg-type]  # a Model, from JSON
        tool = np.array(self.orders.flange_from_tool)
        deadline = time.monotonic() + 1.0
        while True:
            if self._read():
                expected = kinematics.forward(self.record["joints"], tool)
                difference = motion(expected, self.state.flange @ tool)
                shift, turn = float(np.linalg.norm(difference[:3])), float(np.linalg.norm(difference[3:]))
                if shift <= MODEL_LENGTH and turn <= MODEL_TURN:
                    return
                found = f"{1e3 * shift:.0f} mm and {turn:.2f} rad from where a {self.orders.model} would have it"
            else:
                found = "not told"
            if time.monotonic() > deadline:
                raise DeviceNotConnectedError(
                    f"arm '{self.orders.name}': its tool is {found}; check model and flange_from_tool"
                )
            time.sleep(PERIOD)

    # -- the loop ------------------------------------------------------------------------------------------------

    def run(self) -> NoReturn:
        gc.freeze()  # what is loaded stays: the collector need not look at it in the middle of a period
        self._last = time.monotonic()
        deadline = self._last + PERIOD
        ending: float | None = None  # when the last ramp is cut off
        while True:
            self._looks = 0 if self._read() else self._looks + 1
            self._publish(self.servo.status)
            orphan = os.getppid() != self.orders.parent
            _end_if_stuck(ORPHANED if orphan else STUCK)
            now = time.monotonic()
            # A process that slept looks again: the packages may lie there unread.
            if self._looks > 5 and now - float(self.record["time"]) > self.orders.link_timeout:
                self._publish(ArmStatus.LINK_LOST)
                self._leave(orphan)
            partners = self._look_at_partners(now)
            before = self.servo.status
            stopped = self._controller_stop()
            if stopped is None and self._refused > GRACE:
                stopped = ArmStatus.PROGRAM_STOPPED
            if stopped is not None:
                self.servo.fault(stopped, None)
            self.servo.watch(self.state, partners)
            self.servo.look(*self.link.touches.newest(), self.state)
            if self.servo.status != before:
                self._publish(self.servo.status)
            self.servo.hear(*self.link.commands.newest())
            if ending is None and (orphan or self.servo.close_asked):
                ending = now + (PARENTLESS if orphan else CLOSING)
                if orphan:
                    self.servo.fault(ArmStatus.CLOSED, self.state)
            if stopped is not None or self.servo.status in _CONTROLLER_STOPS:
                if ending is not None:
                    self._leave(orphan)
            else:
                self._act(now, partners)
                if ending is not None and (self.servo.resting or now > ending):
                    self._end_program()
                    self._leave(orphan)
            deadline = self._sleep(deadline)

    def _act(self, now: float, partners: list[Any]) -> None:
        if self._refused:  # the next packages tell why
            self._refused += 1
            return
        joints = self.servo.step(now, self.state, partners)
        orders, control = self.orders, self.control
        if joints is None:
            alive = control.kickWatchdog()
        else:
            alive = control.servoJ(joints.tolist(), 0.0, 0.0, PERIOD, orders.lookahead, orders.gain)
        if not alive:
            self._refused = 1
        elif self.servo.zero_asked and self.servo.resting:
            self.servo.zero_asked = False
            self.record["busy_until"] = time.monotonic() + LIBRARY_PATIENCE
            self._publish(self.servo.status)
            if control.zeroFtSensor():
                self.record["zeroed"] += 1
            self.record["busy_until"] = 0.0

    def _read(self) -> bool:
        """The newest package into the record; True if there was one. All fields are of one package: its time stamp is
        the same before and after. A package with numbers that are none counts as none."""
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
            words = receive.getRuntimeState(), receive.getSafetyStatusBits()
            if receive.getTimestamp() == stamp:
                break
        if stamp == float(record["stamp"]) or not np.isfinite(fields).all():
            return False
        record["joints"], record["joint_speeds"], record["tcp_pose"], record["tcp_speed"], record["tcp_force"] = fields
        record["stamp"], record["time"] = stamp, time.monotonic()
        self.state = measured(record, self.frames)
        record["position"] = self.state.sensor[:3, 3]
        self._words = words
        return True

    def _controller_stop(self) -> ArmStatus | None:
        runtime, bits = self._words
        if bits & STOP_BITS:
            return ArmStatus.EMERGENCY_STOP
        if bits & PROTECTIVE_BIT:
            return ArmStatus.PROTECTIVE_STOP
        return None if runtime == PLAYING else ArmStatus.PROGRAM_STOPPED

    def _look_at_partners(self, now: float) -> list[Any]:
        """The newest record of each other arm; None where there is none, or an old one."""
        seen: list[Any] = []
        for index, partner in enumerate(self.orders.partners):
            link = self.partners[index]
            if link is None and int(self.record["cycles"]) % 25 == 0:
                with contextlib.suppress(OSError, ValueError):  # not there, or not whole yet
                    link = self.partners[index] = Link(shared_ring.attach(partner.segment))
            record = None if link is None else link.states.latest()
            if record is not None and now - float(record["beat"]) > self.orders.link_timeout:
                record = None
                self.partners[index] = None  # it may come again under the same name
            seen.append(record if well(record) else None)
        return seen

    def _publish(self, status: ArmStatus) -> None:
        record, servo = self.record, self.servo
        record["beat"], record["status"], record["resting"] = time.monotonic(), status, servo.resting
        record["taken"], record["rejected"], record["shortened"] = servo.taken, servo.rejected, servo.shortened
        record["target"] = record["position"] if servo.motion is None else servo.motion.position
        record["stop"] = record["position"] if servo.stop is None else servo.stop
        self.link.states.write(record)

    def _sleep(self, deadline: float) -> float:
        """Until the absolute deadline; returns the next one. Periods that are missed are not made up for."""
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
        if cycle % WINDOW == WINDOW - 1:
            record["period"] = np.percentile(self._periods, [50.0, 99.0, 100.0])
        return deadline + PERIOD

    # -- ending --------------------------------------------------------------------------------------------------

    def _end_program(self) -> None:
        """Both calls wait for the controller; the driver kills a worker that takes too long."""
        if self.servo.motion is not None:
            self.control.servoStop(10.0)
        self.control.stopScript()

    def _leave(self, orphan: bool) -> NoReturn:
        """Without the library's destructors: they sleep, and may wait for an answer that never comes."""
        if orphan:
            self.segment.remove()
        os._exit(0)


def _end_if_stuck(seconds: float) -> None:
    """The kernel ends this process unless it is asked again within `seconds`, even in the middle of a library call."""
    if sys.platform != "win32":
        signal.setitimer(signal.ITIMER_REAL, seconds)  # SIGALRM is not caught


_CONTROLLER_STOPS = (ArmStatus.PROGRAM_STOPPED, ArmStatus.PROTECTIVE_STOP, ArmStatus.EMERGENCY_STOP)


def main() -> NoReturn:
    # The library prints; stdout is for the one line that says why it failed.
    answer = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the driver, which stops the arm gently
    orders = Orders.from_json(sys.stdin.read())
    if orders.realtime:
        ask_for_realtime(WORKER)  # before the library starts its threads
    try:
        worker = Worker(orders)
        worker.connect()
    except (DeviceError, OSError) as failure:
        kind = type(failure).__name__ if isinstance(failure, DeviceError) else DeviceNotConnectedError.__name__
        answer.write(json.dumps({"error": kind, "text": str(failure)}))
        answer.flush()
        os._exit(FAILED)
    worker.run()


if __name__ == "__main__":
    main()

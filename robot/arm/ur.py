"""The driver of a Universal Robots arm. A worker process (robot.arm.worker) controls the arm; the driver starts it,
reads its state records, writes commands, and raises errors with advice.

The limits here protect the experiment, not people: they are no safety function. Safety planes, speed and force limits
belong in the safety configuration on the pendant.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict

import numpy as np

from robot.arm.channel import (
    HISTORY,
    Channel,
    CommandKind,
    Partner,
    Record,
    Timing,
    check_host,
    make_command_record,
    make_tactile_record,
    make_worker_config,
    shared_segment,
)
from robot.arm.connections import Dashboard
from robot.arm.status import CONNECTING_ADVICE, ArmStatus, PackageLog, StatusHistory, describe_lost_link
from robot.arm.time_alignment import await_state_at
from robot.arm.trajectory import PERIOD, find_min_gap
from robot.common import Closing
from robot.common.kinematics import Kinematics
from robot.common.process import Child
from robot.common.tcp import pose_of
from robot.errors import (
    DeviceAlreadyConnectedError,
    DeviceError,
    DeviceNotConnectedError,
    ProtectiveStop,
    StaleObservationError,
)
from tacsim import pose as se3
from tacsim.interface import Action, ArmState, FloatArray, GelReading, Pose
from tacsim.limits import ActionError, check_action, clip_to_region
from tacsim.models.hardware import UrArmConfig

CLOSE_TIMEOUT = 1.2  # for the worker to brake and end its program; then it is killed [s]
POLL_PERIOD = 2e-3  # between two reads of the worker's records while waiting [s]
_open_arms: set[str] = set()  # names of the arms that are open in this process
_open_arms_lock = threading.Lock()


class URArm(Closing):
    """One UR arm, real or mock; implements tacsim.interface.HardwareArm. A context manager.

    Args:
        config: address, payload, frames and limits.
        name: for messages; unique among the open arms of this process.
        keep_out: minimum distance [m] of its sensor's origin from those of other arms, by arm name. The arm does not
            move until their states are known.
        timeout: of connecting [s].

    Connecting moves nothing. Raises, within `timeout`: DeviceNotConnectedError, DeviceBusyError (another program
    controls the arm), ProtectiveStop, EmergencyStop, DeviceError (not powered, or not in remote control),
    SafetyViolation (outside its workspace, or beyond a force limit), DeviceAlreadyConnectedError.
    """

    _start_path: tuple[FloatArray, FloatArray] | None = (
        None  # of an arm that is led to its start (robot.procedures.to_start)
    )
    _accepted_faults: tuple[ArmStatus, ...] = ()  # faults that do not prevent connecting

    def __init__(
        self,
        config: UrArmConfig,
        name: str,
        *,
        keep_out: Mapping[str, float] | None = None,
        timeout: float = 10.0,
    ) -> None:
        check_host(config, name)
        self.name, self.config, self._timeout = name, config, timeout
        self.latency, self.alignment = config.latency, 0.0
        self._region = config.limits.region
        self._kinematics = Kinematics(config.model)
        self._lock = threading.RLock()
        self._closed = False
        self._is_stop_reported = False  # recover() reported a protective stop; the next call unlocks it
        self.worker: Child | None = None  # its process; None once it is closed
        self._worker_monitor = StatusHistory(config.link_timeout + 5 * POLL_PERIOD)  # on the present worker
        self._partner_names = tuple(keep_out or {})  # their segments are held: these arms may be opened again
        self._segments = [shared_segment(arm) for arm in (name, *self._partner_names)]
        gaps = (keep_out or {}).values()
        partners = [Partner(each.descriptor, gap) for each, gap in zip(self._segments[1:], gaps, strict=True)]
        self._channel, *self._partner_channels = map(Channel, self._segments)
        self._worker_config = make_worker_config(config, name, self._segments[0].descriptor, partners, self._start_path)
        self._frames = self._worker_config.frames
        with _open_arms_lock:
            if name in _open_arms:
                raise DeviceAlreadyConnectedError(f"arm '{name}' is open already; close it first")
            _open_arms.add(name)
        try:
            self._start_worker()
        except BaseException:
            self.close()
            raise

    # -- state ---------------------------------------------------------------------------------------------------

    def status(self) -> ArmStatus:
        """The present status of the arm. Never raises."""
        if self._closed:
            return ArmStatus.CLOSED
        return self._worker_monitor.status(self.worker, self._channel.states.latest)

    def explain(self) -> str:
        """The present status as a sentence, with its numbers."""
        return self._describe_status(self.status())

    def state(self, at: float | None = None) -> ArmState:
        """The newest package, also of a stopped arm; or the state at a past moment [s], between packages.

        Raises StaleObservationError when the newest is older than `link_timeout`, DeviceNotConnectedError without a
        worker, NotAligned for a moment that no package covers.
        """
        if at is None:
            return self._state_from(self._fresh_record())
        state, self.alignment = await_state_at(at, self.state, self.history, self.name, self.config.link_timeout)
        return state

    def history(self, number: int | None = None) -> list[ArmState]:
        """The last states, oldest first, at most `number` (of two seconds); also after a lost link."""
        return [self._state_from(record) for record in self._package_records(HISTORY - 1 if number is None else number)]

    def package_log(self) -> PackageLog:
        """A log of every package from now on."""
        if self._closed:
            raise self._error_of(ArmStatus.CLOSED)
        return PackageLog(self._channel.states)

    def at_rest(self) -> bool:
        """True if the servo target and the arm are at rest."""
        max_speed, max_turn_rate = 1e-3, 10e-3  # a slower arm is at rest [m/s, rad/s]
        record = self._fresh_record()
        twist = self._state_from(record).twist
        speed, turn_rate = float(np.linalg.norm(twist[:3])), float(np.linalg.norm(twist[3:]))
        return bool(record["resting"]) and speed < max_speed and turn_rate < max_turn_rate

    def arrived(self, target: Pose, *, within: float = 50e-6, turn: float = 1e-3) -> bool:
        """True if the arm stands still `within` [m] and `turn` [rad] of `target`."""
        metres, radians = se3.pose_distance(self.state().pose, target)
        return metres <= within and radians <= turn and self.at_rest()

    def timing(self) -> Timing:
        record = self._fresh_record()
        median, p99, longest = record["period"].tolist()
        return Timing(median, p99, longest, int(record["overruns"]), int(record["cycles"]))

    # -- commands ------------------------------------------------------------------------------------------------

    def command(self, target: Pose | None, speed: float | None = None) -> Pose | None:
        """Moves towards `target` (world_from_sensor), at most at `speed` [m/s] and limits.speed; None holds. Returns
        the pose that is sent: a target outside the workspace, or too near to another arm, is clipped on the straight
        path to it.

        Repeat it within `action_timeout`; otherwise the arm stops, at most limits.speed x action_timeout farther.
        Raises ActionError if the target is not a pose or is out of reach, and the error of the status (ProtectiveStop,
        EmergencyStop, SafetyViolation, LinkLost, DeviceNotConnectedError) if the arm cannot follow; then call
        `recover`.
        """
        with self._lock:
            self._require_ready()
            if target is None:
                self._send_command(CommandKind.HOLD)
                return None
            check_action(Action({self.name: target}), (self.name,), self.name)
            if speed is not None and not speed > 0.0:
                raise ActionError(f"arm '{self.name}': the speed must be positive, got {speed} m/s")
            state = self.state()
            allowed_target, _ = clip_to_region(target, state.pose, self._region, self._keep_out_spheres())
            flange = self._frames.flange(se3.to_matrix(allowed_target))
            assert state.joints is not None
            if self._kinematics.inverse(flange, state.joints) is None:
                position = np.round(allowed_target.position, 4).tolist()
                raise ActionError(
                    f"target of arm '{self.name}' at {position} m is out of reach; give a nearer or less turned pose"
                )
            self._send_command(CommandKind.TARGET, allowed_target, math.inf if speed is None else speed)
            return allowed_target

    def stop(self) -> None:
        """Brakes to rest within the limits; the next command continues from there. After a fault it has no effect."""
        with self._lock:
            if not self._closed:
                self._send_command(CommandKind.HOLD)

    def report_tactile(self, reading: GelReading | None) -> None:
        """Reports the reading of the gels: beyond limits.depth or limits.shear the arm stops, and it holds while the
        last picture is older than `observation_timeout`. None suspends both guards until the next report."""
        with self._lock:
            if not self._closed:
                reported = GelReading(math.nan) if reading is None else reading
                self._channel.tactile.write(make_tactile_record(reported.exposed, reported.depth, reported.shear))

    def zero_wrench(self) -> None:
        """Zeroes the force sensor. The arm must be at rest and without contact.

        Raises DeviceError if the arm moves or the controller does not zero it, and the error of a lost link or a stop.
        """
        with self._lock:
            status = self.status()
            if status >= ArmStatus.PROGRAM_STOPPED or status == ArmStatus.CONNECTING:
                raise self._error_of(status)
            before = int(self._fresh_record()["zeroed"])
            if not self.at_rest():
                raise DeviceError(f"arm '{self.name}' moves; stop it before you zero its wrench")
            self._send_command(CommandKind.ZERO_WRENCH)
            try:
                self._wait_until(lambda: int(self._fresh_record()["zeroed"]) > before, 5.0, "its wrench was not zeroed")
            except BaseException:
                self._send_command(CommandKind.HOLD)  # cancels the request
                raise

    def recover(self) -> None:
        """Unlocks a protective stop and starts a new worker, which begins at the measured pose and moves nothing; it
        drops earlier commands. A protective stop not reported before, after a lost link, first raises ProtectiveStop.

        Raises EmergencyStop while one is engaged (a person must release it), and every error of connecting: the arm
        stays stopped while the cause lasts. Only a person decides to call it; no code here calls it.
        """
        with self._lock:
            if self._closed:
                raise self._error_of(ArmStatus.CLOSED)
            was_reported, self._is_stop_reported = self._is_stop_reported, False
            if was_reported or self.status().is_controller_stop:
                with Dashboard(self.config.host) as dashboard:
                    dashboard.unlock(f"arm '{self.name}'")
            self._end_worker()
            try:
                self._start_worker()
            except ProtectiveStop as stop:
                self._is_stop_reported = True
                raise ProtectiveStop(f"{stop}; the next recover() unlocks it") from stop

    def close(self) -> None:
        """Stops the arm and ends its worker, within 1.5 s. A second call does nothing."""
        with self._lock:
            if self._closed:
                return
            self._end_worker()
            self._closed = True
            self._channel = Channel(None)
            del self._partner_channels, self._segments
            _open_arms.discard(self.name)

    # -- the worker ----------------------------------------------------------------------------------------------

    def _start_worker(self) -> None:
        """Starts a worker and waits until it is connected. Raises the error of a fault present at the start."""
        self._worker_monitor = StatusHistory(self.config.link_timeout + 5 * POLL_PERIOD)
        self.worker = Child(
            "robot.arm.worker",
            name=f"the worker of arm '{self.name}'",
            advice="find the cause, then recover()",
            descriptors=[segment.descriptor for segment in self._segments],
        )
        deadline = time.monotonic() + self._timeout
        try:
            self.worker.request(asdict(self._worker_config), timeout=self._timeout)
        except DeviceNotConnectedError as failure:
            if time.monotonic() < deadline:
                raise
            raise DeviceNotConnectedError(
                f"arm '{self.name}': the controller at {self.config.host} did not answer for {self._timeout:g} s while "
                "connecting. Restart it, or check which other program holds it"
            ) from failure
        status = self.status()
        if status.is_fault and status not in self._accepted_faults:
            raise status.error(self._describe_status(status) + CONNECTING_ADVICE.get(status, ""))

    def _end_worker(self) -> None:
        """Asks the worker to brake and end, then kills it."""
        if self.worker is None:
            return
        record = self._channel.states.latest()
        connected = self.worker.running and record is not None and record["status"] != ArmStatus.CONNECTING
        if connected:
            self._send_command(CommandKind.CLOSE)
        self.worker.close(CLOSE_TIMEOUT if connected else 0.0)
        self.worker = None

    def _send_command(
        self, kind: CommandKind, target: Pose | None = None, speed: float = math.inf, fraction: float = 0.0
    ) -> None:
        numbers = None if target is None else np.concatenate([target.position, target.quaternion])
        self._channel.commands.write(make_command_record(time.monotonic(), kind, numbers, speed, fraction))

    def _wait_until(self, done: Callable[[], bool], timeout: float, otherwise: str) -> None:
        deadline = time.monotonic() + timeout
        while not done():
            status = self.status()
            if status >= ArmStatus.PROGRAM_STOPPED:
                raise self._error_of(status)
            if time.monotonic() > deadline:
                raise DeviceError(f"arm '{self.name}': {otherwise} within {timeout:g} s")
            time.sleep(POLL_PERIOD)

    # -- records -------------------------------------------------------------------------------------------------

    def _fresh_record(self) -> Record:
        """The newest record. Raises unless it is fresh."""
        status = self.status()
        record = None if self._closed else self._channel.states.latest()
        if status == ArmStatus.LINK_LOST and record is not None:
            raise StaleObservationError(
                f"arm '{self.name}': the link is lost, {self._describe_lost_link(record)}, then recover()"
            )
        if status in (ArmStatus.WORKER_DEAD, ArmStatus.CLOSED, ArmStatus.CONNECTING) or record is None:
            raise self._error_of(status)
        return record

    def _package_records(self, number: int) -> Record:
        """The newest records, one per package, oldest first."""
        if self._closed:
            raise self._error_of(ArmStatus.CLOSED)
        records = self._channel.states.recent(HISTORY - 1)
        records = records[records["stamp"] != 0.0]
        first = np.flatnonzero(np.diff(records["time"], prepend=-np.inf) > 0.0)
        newest: Record = records[first][-number:]
        return newest

    def _state_from(self, record: Record) -> ArmState:
        measured = self._frames.measure(record)
        return ArmState(
            pose=pose_of(measured.sensor),
            twist=measured.twist,
            wrench=measured.wrench,
            joints=measured.joints,
            time=float(record["time"]) - self.config.latency,
        )

    def _require_ready(self) -> None:
        """Raises the error of a status in which the arm cannot follow commands."""
        partner_timeout = 0.5  # of a command, for the state of the other arm of a keep-out [s]
        deadline = time.monotonic() + partner_timeout
        while (status := self.status()) == ArmStatus.WAITING and time.monotonic() < deadline:
            time.sleep(POLL_PERIOD)
        if status.is_fault or status in (ArmStatus.WAITING, ArmStatus.CONNECTING):
            raise self._error_of(status)

    def _keep_out_spheres(self) -> list[tuple[np.ndarray, float]]:
        """Positions (3,) of the other arms [m], and the gap to each [m] that the servo keeps: it would not reach a
        nearer target."""
        spheres = []
        for partner, channel in zip(self._worker_config.partners, self._partner_channels, strict=True):
            record = channel.states.latest()
            if record is not None:
                spheres.append((record["position"], find_min_gap(partner.distance, float(record["top_speed"]))))
        return spheres

    def _error_of(self, status: ArmStatus) -> DeviceError:
        return status.error(self._describe_status(status))

    def _describe_status(self, status: ArmStatus) -> str:
        slow_period = 2.0 * PERIOD  # of the loop; a longer one makes the arm slow [s]
        text = f"arm '{self.name}' {status.text}"
        record = None if self._closed else self._channel.states.latest()
        if record is not None and record["stamp"] != 0.0:
            if status == ArmStatus.FORCE_LIMIT:
                force, torque = np.linalg.norm(self._frames.measure(record).wrench.reshape(2, 3), axis=1)
                limits = self.config.limits
                text += f" (now {force:.1f} of {limits.force:g} N, {torque:.2f} of {limits.torque:g} N m)"
            elif status == ArmStatus.WORKSPACE_LIMIT:
                text += f" ({self._region.violated_face(record['position']) or 'it is inside again'})"
            elif status == ArmStatus.PARTNER_STOPPED:
                text += "".join(f" (arm '{name}' {fault.text})" for name, fault in self._partner_faults())
            elif status < ArmStatus.FORCE_LIMIT and (period := float(record["period"][0])) > slow_period:
                text += f" (slowly: its loop takes {1e3 * period:.0f} ms, not 2; the machine is too busy)"
        worker = self.worker
        if worker is not None and status == ArmStatus.WORKER_DEAD:
            text += f" ({worker.exit_report})"
        elif record is not None and status == ArmStatus.LINK_LOST:
            text += f" ({self._describe_lost_link(record)})"
        return text

    def _describe_lost_link(self, record: Record) -> str:
        ended = 0 if self.worker is None else self.worker.exit_status
        return describe_lost_link(record, self.config, ended, time.monotonic())

    def _partner_faults(self) -> Iterator[tuple[str, ArmStatus]]:
        """Names and faults of the other arms of a keep-out, without those that stopped because of another arm."""
        for name, channel in zip(self._partner_names, self._partner_channels, strict=True):
            record = channel.states.latest()
            status = ArmStatus.CONNECTING if record is None else ArmStatus(int(record["status"]))
            if status.is_fault and status != ArmStatus.PARTNER_STOPPED:
                yield name, status

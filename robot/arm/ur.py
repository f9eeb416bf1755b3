"""The driver of a Universal Robots arm. A worker process (robot.arm.worker) controls the arm; the driver starts it,
reads its state records, writes commands, and raises errors that say what to do.

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
    Timing,
    command_record,
    segment_of,
    tactile_record,
)
from robot.arm.controller.dashboard import Dashboard
from robot.arm.lost_link import PackageLog, Verdict, explain_lost_link
from robot.arm.shared_ring import Record
from robot.arm.status import AT_CONNECTING, ArmStatus
from robot.arm.time_alignment import await_state_at
from robot.arm.trajectory import PERIOD
from robot.arm.worker_config import check_host, worker_config
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
POLL = 2e-3  # between two looks at the worker's records while waiting [s]
_open: set[str] = set()  # names of the arms that are open in this process
_opening = threading.Lock()


class URArm(Closing):
    """One UR arm, real or mock; implements tacsim.interface.HardwareArm. A context manager.

    Args:
        config: its address, what it carries, its limits.
        name: in messages; unique among the open arms of this process.
        keep_out: minimum distance [m] of its sensor's origin to those of the arms of these names. The arm does not move
            until their state is known.
        timeout: of connecting [s].

    Connecting moves nothing. Raises, within `timeout`: DeviceNotConnectedError, DeviceBusyError (another program
    controls the arm), ProtectiveStop, EmergencyStop, DeviceError (not powered, or not in remote control),
    SafetyViolation (it stands outside its workspace, or feels too much), DeviceAlreadyConnectedError.
    """

    _way: tuple[FloatArray, FloatArray] | None = None  # of an arm that is led to its start (robot.procedures.to_start)
    _bearable: tuple[ArmStatus, ...] = ()  # faults that it may be opened with

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
        self._stop_told = False  # recover() found a protective stop: the next one unlocks it
        self._worker: Child | None = None
        self._verdict = Verdict(config.link_timeout + 5 * POLL)  # on the present worker
        # Those of the other arms are held, too: they may be opened, closed and opened again meanwhile.
        self._partner_names = tuple(keep_out or {})
        self._segments = [segment_of(arm) for arm in (name, *self._partner_names)]
        gaps = (keep_out or {}).values()
        partners = [Partner(each.descriptor, gap) for each, gap in zip(self._segments[1:], gaps, strict=True)]
        self._channel, *self._others = map(Channel, self._segments)
        self._worker_config = worker_config(config, name, self._segments[0].descriptor, partners, self._way)
        self._frames = self._worker_config.frames
        with _opening:
            if name in _open:
                raise DeviceAlreadyConnectedError(f"arm '{name}' is open already; close it first")
            _open.add(name)
        try:
            self._start()
        except BaseException:
            self.close()
            raise

    # -- state ---------------------------------------------------------------------------------------------------

    def status(self) -> ArmStatus:
        """What the arm is doing now; never raises."""
        if self._closed:
            return ArmStatus.CLOSED
        return self._verdict.status(self._worker, self._channel.states.latest)

    def explain(self) -> str:
        """The status in words, with its numbers."""
        return self._explain(self.status())

    def state(self, at: float | None = None) -> ArmState:
        """The newest package, also of a stopped arm; or the state at a past moment [s], between packages.

        Raises StaleObservationError when the newest is older than `link_timeout`, DeviceNotConnectedError without a
        worker, NotAligned for a moment that no package covers.
        """
        if at is None:
            return self._state(self._record())
        state, self.alignment = await_state_at(at, self.state, self.history, self.name, self.config.link_timeout)
        return state

    def history(self, number: int | None = None) -> list[ArmState]:
        """The last packages, oldest first, at most `number` (two seconds are kept); also after a lost link."""
        return [self._state(record) for record in self._packages(HISTORY - 1 if number is None else number)]

    def package_log(self) -> PackageLog:
        """Every package from now on."""
        if self._closed:
            raise self._error(ArmStatus.CLOSED)
        return PackageLog(self._channel.states)

    def at_rest(self) -> bool:
        """True if neither the servo target nor the arm itself moves."""
        max_speed, max_turn_rate = 1e-3, 10e-3  # an arm slower than this is at rest [m/s, rad/s]
        record = self._record()
        twist = self._state(record).twist
        still = float(np.linalg.norm(twist[:3])) < max_speed and float(np.linalg.norm(twist[3:])) < max_turn_rate
        return bool(record["resting"]) and still

    def arrived(self, target: Pose, *, within: float = 50e-6, turn: float = 1e-3) -> bool:
        """True if the arm stands still `within` [m] and `turn` [rad] of `target`."""
        metres, radians = se3.pose_distance(self.state().pose, target)
        return metres <= within and radians <= turn and self.at_rest()

    def timing(self) -> Timing:
        record = self._record()
        median, p99, longest = record["period"].tolist()
        return Timing(median, p99, longest, int(record["overruns"]), int(record["cycles"]))

    # -- commands ------------------------------------------------------------------------------------------------

    def command(self, target: Pose | None, speed: float | None = None) -> Pose | None:
        """Moves towards `target` (world_from_sensor), at most at `speed` [m/s] and limits.speed; None holds. Returns
        the pose that is sent: a target outside the workspace, or too near to another arm, is clipped on the straight
        path there.

        Must be repeated within `action_timeout`, else the arm comes to rest, at most limits.speed x action_timeout
        farther. Raises ActionError for what is not a pose or is out of reach, and the error of its status
        (ProtectiveStop, EmergencyStop, SafetyViolation, LinkLost, DeviceNotConnectedError) when it cannot follow; then
        only `recover` helps.
        """
        with self._lock:
            self._require_able()
            if target is None:
                self._send(CommandKind.HOLD)
                return None
            check_action(Action({self.name: target}), (self.name,), self.name)
            if speed is not None and not speed > 0.0:
                raise ActionError(f"arm '{self.name}' was asked for a speed of {speed} m/s; it must be positive")
            state = self.state()
            allowed, _ = clip_to_region(target, state.pose, self._region, self._spheres())
            flange = self._frames.flange(se3.to_matrix(allowed))
            assert state.joints is not None
            if self._kinematics.inverse(flange, state.joints) is None:
                raise ActionError(
                    f"target of arm '{self.name}' at {np.round(allowed.position, 4).tolist()} m is out of its reach; "
                    "ask for a pose nearer to the arm, or turned less"
                )
            self._send(CommandKind.TARGET, allowed, math.inf if speed is None else speed)
            return allowed

    def stop(self) -> None:
        """Brakes to rest within the limits; the next command moves on from there. After a fault the arm is at rest."""
        with self._lock:
            if not self._closed:
                self._send(CommandKind.HOLD)

    def report_tactile(self, reading: GelReading | None) -> None:
        """Reports what the sensors show: beyond limits.depth or limits.shear the arm stops, and it holds while the last
        picture is older than `observation_timeout`. None suspends both guards until the next report."""
        with self._lock:
            if not self._closed:
                known = GelReading(math.nan) if reading is None else reading
                self._channel.tactile.write(tactile_record(known.exposed, known.depth, known.shear))

    def zero_wrench(self) -> None:
        """Zeroes the force sensor. The arm must be at rest and touch nothing.

        Raises DeviceError if it moves or the controller does not do it, and the error of a lost link or a stop.
        """
        with self._lock:
            status = self.status()
            if status >= ArmStatus.PROGRAM_STOPPED or status == ArmStatus.CONNECTING:
                raise self._error(status)
            before = int(self._record()["zeroed"])
            if not self.at_rest():
                raise DeviceError(f"arm '{self.name}' moves; stop it before its wrench is zeroed")
            self._send(CommandKind.ZERO_WRENCH)
            try:
                self._await(lambda: int(self._record()["zeroed"]) > before, 5.0, "its wrench was not zeroed")
            except BaseException:
                self._send(CommandKind.HOLD)  # nor later
                raise

    def recover(self) -> None:
        """After a stop, a fault or a lost link: unlocks a protective stop and starts a new worker, which begins at the
        measured pose and moves nothing. Earlier commands are forgotten. A stop that nobody was told of, after a lost
        link, raises ProtectiveStop first; the next call unlocks it.

        Raises EmergencyStop while one is engaged (a person must release it), and whatever connecting raises: the arm
        stays stopped while what stopped it lasts. Only a person decides to call it: nothing here does.
        """
        with self._lock:
            if self._closed:
                raise self._error(ArmStatus.CLOSED)
            told, self._stop_told = self._stop_told, False
            if told or self.status().is_controller_stop:
                with Dashboard(self.config.host) as dashboard:
                    dashboard.unlock(f"arm '{self.name}'")
            self._end_worker()
            try:
                self._start()
            except ProtectiveStop as stop:
                self._stop_told = True
                raise ProtectiveStop(f"{stop}; the next recover() unlocks it") from stop

    def close(self) -> None:
        """Stops the arm and ends its worker; at most 1.5 s. A second call does nothing."""
        with self._lock:
            if self._closed:
                return
            self._end_worker()
            self._closed = True
            self._channel = Channel(None)
            del self._others, self._segments
            _open.discard(self.name)

    # -- the worker ----------------------------------------------------------------------------------------------

    def _start(self) -> None:
        """Starts a worker and waits until it is connected. Raises the error of a fault that it begins with."""
        self._verdict = Verdict(self.config.link_timeout + 5 * POLL)
        self._worker = Child(
            "robot.arm.worker",
            name=f"the worker of arm '{self.name}'",
            advice="see why, then recover()",
            descriptors=[segment.descriptor for segment in self._segments],
        )
        deadline = time.monotonic() + self._timeout
        try:
            self._worker.ask(asdict(self._worker_config), timeout=self._timeout)
        except DeviceNotConnectedError as failure:
            if time.monotonic() < deadline:
                raise
            raise DeviceNotConnectedError(
                f"arm '{self.name}': the controller at {self.config.host} fell silent while connecting; nothing for "
                f"{self._timeout:g} s. Restart it, or look what else holds it"
            ) from failure
        status = self.status()
        if status.is_fault and status not in self._bearable:
            raise status.error(self._explain(status) + AT_CONNECTING.get(status, ""))

    def _end_worker(self) -> None:
        """Asks the worker to brake and end, then kills it."""
        if self._worker is None:
            return
        record = self._channel.states.latest()
        connected = self._worker.running and record is not None and record["status"] != ArmStatus.CONNECTING
        if connected:
            self._send(CommandKind.CLOSE)
        self._worker.close(CLOSE_TIMEOUT if connected else 0.0)
        self._worker = None

    def _send(self, kind: CommandKind, target: Pose | None = None, speed: float = math.inf, share: float = 0.0) -> None:
        vector = None if target is None else np.concatenate([target.position, target.quaternion])
        self._channel.commands.write(command_record(time.monotonic(), kind, vector, speed, share))

    def _await(self, done: Callable[[], bool], timeout: float, otherwise: str) -> None:
        deadline = time.monotonic() + timeout
        while not done():
            status = self.status()
            if status >= ArmStatus.PROGRAM_STOPPED:
                raise self._error(status)
            if time.monotonic() > deadline:
                raise DeviceError(f"arm '{self.name}': {otherwise} within {timeout:g} s")
            time.sleep(POLL)

    # -- records -------------------------------------------------------------------------------------------------

    def _record(self) -> Record:
        """The newest record. Raises unless it is fresh."""
        status = self.status()
        record = None if self._closed else self._channel.states.latest()
        if status == ArmStatus.LINK_LOST and record is not None:
            raise StaleObservationError(
                f"arm '{self.name}': the link is lost, {self._lost_link(record)}, then recover()"
            )
        if status in (ArmStatus.WORKER_DEAD, ArmStatus.CLOSED, ArmStatus.CONNECTING) or record is None:
            raise self._error(status)
        return record

    def _packages(self, number: int) -> Record:
        """The newest records, one a package, oldest first."""
        if self._closed:
            raise self._error(ArmStatus.CLOSED)
        records = self._channel.states.recent(HISTORY - 1)
        records = records[records["stamp"] != 0.0]
        first = np.flatnonzero(np.diff(records["time"], prepend=-np.inf) > 0.0)
        kept: Record = records[first][-number:]
        return kept

    def _state(self, record: Record) -> ArmState:
        now = self._frames.measure(record)
        return ArmState(
            pose=pose_of(now.sensor),
            twist=now.twist,
            wrench=now.wrench,
            joints=now.joints,
            time=float(record["time"]) - self.config.latency,
        )

    def _require_able(self) -> None:
        """Raises the error of a status in which the arm follows no commands."""
        partner_timeout = 0.5  # how long a command waits for the state of the other arm of a keep-out [s]
        deadline = time.monotonic() + partner_timeout
        while (status := self.status()) == ArmStatus.WAITING and time.monotonic() < deadline:
            time.sleep(POLL)
        if status.is_fault or status in (ArmStatus.WAITING, ArmStatus.CONNECTING):
            raise self._error(status)

    def _spheres(self) -> list[tuple[np.ndarray, float]]:
        """Positions (3,) of the other arms [m], and the keep-out distance to each [m]."""
        spheres = []
        for partner, channel in zip(self._worker_config.partners, self._others, strict=True):
            record = channel.states.latest()
            if record is not None:
                spheres.append((record["position"], partner.distance))
        return spheres

    def _error(self, status: ArmStatus) -> DeviceError:
        return status.error(self._explain(status))

    def _explain(self, status: ArmStatus) -> str:
        slow_period = 2.0 * PERIOD  # a loop whose median period is longer makes its arm slow [s]
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
                text += "".join(f" (arm '{name}' {fault.text})" for name, fault in self._first_faults())
            elif status < ArmStatus.FORCE_LIMIT and (period := float(record["period"][0])) > slow_period:
                text += f" (slowly: its loop takes {1e3 * period:.0f} ms, not 2; the machine is too busy)"
        worker = self._worker
        if worker is not None and status == ArmStatus.WORKER_DEAD:
            text += f" ({worker.last_words})"
        elif record is not None and status == ArmStatus.LINK_LOST:
            text += f" ({self._lost_link(record)})"
        return text

    def _lost_link(self, record: Record) -> str:
        ended = 0 if self._worker is None else self._worker.exit_status
        return explain_lost_link(record, self.config, ended, time.monotonic())

    def _first_faults(self) -> Iterator[tuple[str, ArmStatus]]:
        """Of the other arms of a keep-out, those that did not stop because of another."""
        for name, channel in zip(self._partner_names, self._others, strict=True):
            record = channel.states.latest()
            status = ArmStatus.CONNECTING if record is None else ArmStatus(int(record["status"]))
            if status.is_fault and status != ArmStatus.PARTNER_STOPPED:
                yield name, status

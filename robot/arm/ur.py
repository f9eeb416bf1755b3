"""A Universal Robots arm behind the contract. The work is done by a process of its own (robot.arm.worker); this side
starts it, reads its records, writes commands, and turns what can go wrong into errors that say what to do.

The guards here are for the work, not for people: they are no safety function. Safety planes, speed and force limits
belong into the safety configuration on the pendant.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Self

import numpy as np

from robot.arm import shared_ring
from robot.arm.channel import (
    HISTORY,
    ArmStatus,
    Channel,
    CommandKind,
    Partner,
    WorkerConfig,
    command_record,
    tactile_record,
)
from robot.arm.dashboard import Dashboard
from robot.common import MOCK_SERIAL
from robot.common.kinematics import Kinematics, pose
from robot.common.loopback import is_loopback
from robot.common.process import Child
from robot.common.tcp import pose_of
from robot.errors import (
    DeviceAlreadyConnectedError,
    DeviceError,
    DeviceNotConnectedError,
    StaleObservationError,
)
from tacsim import pose as se3
from tacsim.control.gel_monitor import GelReading
from tacsim.interface import Action, ArmState, Pose
from tacsim.limits import ActionError, check_action, clip_to_region
from tacsim.models.hardware import UrArmConfig

CONNECT_TIMEOUT = 10.0  # of the constructor and of recover [s]
CLOSE_TIMEOUT = 1.2  # for the worker to ramp down and end its program; then it is killed [s]
POLL = 2e-3  # how often the worker's records are looked at while waiting [s]
PARTNER_PATIENCE = 0.5  # how long a command waits for the other arm of a keep-out to be seen [s]
REST_SPEED, REST_TURN = 1e-3, 10e-3  # slower than this is standing still [m/s, rad/s]


@dataclass(frozen=True, slots=True)
class Timing:
    """How the servo loop kept time, over its last 500 periods."""

    median: float  # of the period [s]
    p99: float
    longest: float
    overruns: int  # periods that were missed, ever
    cycles: int  # periods, ever


class URArm:
    """One UR arm, real or mock; implements tacsim.interface.Arm. A context manager.

    Args:
        facts: where it is, what it carries, what it may do.
        name: in messages; no other open arm of this process may have it.
        keep_out: least distance [m] of the sensors' origins to the arms of these names. The arm stands still until it
            can see them.
        timeout: of connecting [s].

    Connecting moves nothing. Raises, within `timeout`: DeviceNotConnectedError, DeviceBusyError (another program
    controls the arm), ProtectiveStop, EmergencyStop, DeviceError (not powered, or not in remote control),
    SafetyViolation (it stands outside its workspace), DeviceAlreadyConnectedError.
    """

    def __init__(
        self,
        config: UrArmConfig,
        name: str,
        *,
        keep_out: Mapping[str, float] | None = None,
        timeout: float = CONNECT_TIMEOUT,
    ) -> None:
        _check_host(config, name)
        self.name, self.config, self._timeout = name, config, timeout
        self._region = config.limits.region
        self._kinematics = Kinematics(config.model)
        self._lock = threading.RLock()
        self._closed = False
        self._worker: Child | None = None
        shared_ring.sweep()
        try:
            self._segment = shared_ring.create(shared_ring.segment_name(os.getpid(), name), Channel.SIZE)
        except FileExistsError as failure:
            raise DeviceAlreadyConnectedError(f"arm '{name}' is open already; close it first") from failure
        self._channel = Channel(self._segment)
        self._worker_config = _worker_config(config, name, self._segment.name, keep_out or {})
        self._frames = self._worker_config.frames
        self._others: dict[str, Channel] = {}
        try:
            self._start()
            status = self.status()
            if status == ArmStatus.WORKSPACE_LIMIT:
                raise self._error(status)
        except BaseException:
            self.close()
            raise

    # -- what it says --------------------------------------------------------------------------------------------

    def status(self) -> ArmStatus:
        """How the arm is now; never raises."""
        if self._closed:
            return ArmStatus.CLOSED
        ended = self._worker is None or not self._worker.running
        record = self._channel.states.latest()
        last = ArmStatus.WORKER_DEAD if record is None else ArmStatus(int(record["status"]))
        if ended:
            return last if last == ArmStatus.LINK_LOST else ArmStatus.WORKER_DEAD
        now = time.monotonic()
        if record is not None and last != ArmStatus.CONNECTING and not _fresh(record, now, self.config.link_timeout):
            return ArmStatus.LINK_LOST
        return last

    def explain(self) -> str:
        """The status in words, with the numbers that belong to it."""
        return self._explain(self.status())

    def state(self) -> ArmState:
        """The newest package. A stopped arm still tells its state.

        Raises StaleObservationError when there is none within `link_timeout`, DeviceNotConnectedError without a worker.
        """
        return self._state(self._record())

    def history(self, number: int = HISTORY - 1) -> list[ArmState]:
        """The last packages, oldest first, at most `number`; two seconds are kept. Also those of a lost link."""
        return [self._state(record) for record in self._packages(number)]

    def at_rest(self) -> bool:
        """True if neither the servo target nor the arm itself moves."""
        record = self._record()
        twist = self._state(record).twist
        still = float(np.linalg.norm(twist[:3])) < REST_SPEED and float(np.linalg.norm(twist[3:])) < REST_TURN
        return bool(record["resting"]) and still

    def arrived(self, target: Pose, *, within: float = 50e-6, turn: float = 1e-3) -> bool:
        """True if the arm stands still `within` [m] and `turn` [rad] of `target`."""
        metres, radians = se3.distance(self.state().pose, target)
        return metres <= within and radians <= turn and self.at_rest()

    def timing(self) -> Timing:
        record = self._record()
        median, p99, longest = record["period"].tolist()
        return Timing(median, p99, longest, int(record["overruns"]), int(record["cycles"]))

    # -- what it is asked ----------------------------------------------------------------------------------------

    def command(self, target: Pose | None) -> Pose | None:
        """Asks for `target` (world_from_sensor); None holds. Returns the pose that is really asked of the arm: a target
        outside the workspace, or too near to another arm, is shortened on the straight way there.

        Must come again within `action_timeout`, else the arm holds. Raises ActionError for what is no pose or out of
        the arm's reach, and the error of its status (ProtectiveStop, EmergencyStop, SafetyViolation, LinkLost,
        DeviceNotConnectedError) when it cannot follow; then only `recover` helps.
        """
        with self._lock:
            self._require_able()
            if target is None:
                self._send(CommandKind.HOLD)
                return None
            check_action(Action({self.name: target}), (self.name,), self.name)
            state = self.state()
            allowed, _ = clip_to_region(target, state.pose, self._region, self._spheres())
            flange = self._frames.flange(se3.to_matrix(allowed))
            assert state.joints is not None
            if self._kinematics.inverse(flange, state.joints) is None:
                raise ActionError(
                    f"target of arm '{self.name}' at {np.round(allowed.position, 4).tolist()} m is out of its reach; "
                    "ask for a pose nearer to the arm, or turned less"
                )
            self._send(CommandKind.TARGET, allowed)
            return allowed

    def stop(self) -> None:
        """Brakes to rest within the limits; the next command goes on from there. A faulty arm stands already."""
        with self._lock:
            if not self._closed:
                self._send(CommandKind.HOLD)

    def report_tactile(self, shown: GelReading | None) -> None:
        """What the sensors show by now: beyond limits.depth or limits.shear the arm stops, and it stands once the last
        picture is older than `observation_timeout`. None: nobody looks by now, and neither is watched."""
        with self._lock:
            if not self._closed:
                known = GelReading(math.nan) if shown is None else shown
                self._channel.tactile.write(tactile_record(known.seen, known.depth, known.shear))

    def zero_wrench(self) -> None:
        """Makes the present force the zero. The arm must stand, and touch nothing.

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
            self._await(lambda: int(self._record()["zeroed"]) > before, 5.0, "its wrench was not zeroed")

    def recover(self) -> None:
        """After a stop, a fault or a lost link: unlocks a protective stop and starts a new worker, which begins at the
        pose it measures and moves nothing. What was asked before is forgotten.

        Raises EmergencyStop while one is engaged (a person must release it), and whatever connecting raises. A person
        decides whether it may be called: nothing here calls it.
        """
        with self._lock:
            if self._closed:
                raise self._error(ArmStatus.CLOSED)
            if self.status() in _DASHBOARD_FIRST:
                with Dashboard(self.config.host) as dashboard:
                    dashboard.unlock(f"arm '{self.name}'")
            self._end_worker()
            self._start()

    def close(self) -> None:
        """Stops the arm and ends its worker; at most 1.5 s. A second call does nothing."""
        with self._lock:
            if self._closed:
                return
            self._end_worker()
            self._closed = True
            self._others.clear()
            del self._channel
            self._segment.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    # -- the worker ----------------------------------------------------------------------------------------------

    def _start(self) -> None:
        """Starts a worker and waits until it is connected."""
        self._worker = Child(
            "robot.arm.worker", name=f"the worker of arm '{self.name}'", advice="see why, then recover()"
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

    def _end_worker(self) -> None:
        """Asks the worker to ramp down and end, then kills it."""
        if self._worker is None:
            return
        record = self._channel.states.latest()
        connected = self._worker.running and record is not None and record["status"] != ArmStatus.CONNECTING
        if connected:
            self._send(CommandKind.CLOSE)
        self._worker.close(CLOSE_TIMEOUT if connected else 0.0)
        self._worker = None

    def _send(self, kind: CommandKind, target: Pose | None = None) -> None:
        vector = None if target is None else np.concatenate([target.position, target.quaternion])
        self._channel.commands.write(command_record(time.monotonic(), kind, vector))

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

    def _record(self) -> shared_ring.Record:
        """The newest record, if it may be believed."""
        status = self.status()
        record = None if self._closed else self._channel.states.latest()
        if status == ArmStatus.LINK_LOST and record is not None:
            age = time.monotonic() - float(record["time"])
            raise StaleObservationError(
                f"arm '{self.name}': its last package is {1e3 * age:.0f} ms old, more than link_timeout = "
                f"{1e3 * self.config.link_timeout:g} ms; see the cable, then recover()"
            )
        if status in (ArmStatus.WORKER_DEAD, ArmStatus.CLOSED, ArmStatus.CONNECTING) or record is None:
            raise self._error(status)
        return record

    def _packages(self, number: int) -> shared_ring.Record:
        """The newest records, one a package, oldest first."""
        if self._closed:
            raise self._error(ArmStatus.CLOSED)
        records = self._channel.states.recent(HISTORY - 1)
        records = records[records["stamp"] != 0.0]
        first = np.flatnonzero(np.diff(records["time"], prepend=-np.inf) > 0.0)
        kept: shared_ring.Record = records[first][-number:]
        return kept

    def _state(self, record: shared_ring.Record) -> ArmState:
        now = self._frames.measure(record)
        return ArmState(
            pose=pose_of(now.sensor),
            twist=now.twist,
            wrench=now.wrench,
            joints=now.joints,
            time=float(record["time"]) - self.config.latency,
        )

    def _require_able(self) -> None:
        """Raises the error of a status in which the arm follows no command."""
        deadline = time.monotonic() + PARTNER_PATIENCE
        while (status := self.status()) == ArmStatus.WAITING and time.monotonic() < deadline:
            time.sleep(POLL)
        if status.is_fault or status in (ArmStatus.WAITING, ArmStatus.CONNECTING):
            raise self._error(status)

    def _spheres(self) -> list[tuple[np.ndarray, float]]:
        """Where the other arms are, and how far to stay away."""
        spheres = []
        for partner in self._worker_config.partners:
            if partner.segment not in self._others:
                self._others[partner.segment] = Channel(shared_ring.attach(partner.segment))
            record = self._others[partner.segment].states.latest()
            if record is not None:
                spheres.append((record["position"], partner.distance))
        return spheres

    def _error(self, status: ArmStatus) -> DeviceError:
        return status.error(self._explain(status))

    def _explain(self, status: ArmStatus) -> str:
        text = f"arm '{self.name}' {status.text}"
        record = None if self._closed else self._channel.states.latest()
        if record is not None and record["stamp"] != 0.0:
            if status == ArmStatus.FORCE_LIMIT:
                force, torque = np.linalg.norm(self._frames.measure(record).wrench.reshape(2, 3), axis=1)
                limits = self.config.limits
                text += f" (now {force:.1f} of {limits.force:g} N, {torque:.2f} of {limits.torque:g} N m)"
            elif status == ArmStatus.WORKSPACE_LIMIT:
                text += f" ({self._region.broken(record['position']) or 'it is inside again'})"
        return text


_DASHBOARD_FIRST = (ArmStatus.PROTECTIVE_STOP, ArmStatus.EMERGENCY_STOP, ArmStatus.PROGRAM_STOPPED)


def _fresh(record: shared_ring.Record, now: float, link_timeout: float) -> bool:
    """Whether the worker still hears the controller; while it waits for a slow call it says until when."""
    return now <= max(float(record["time"]) + link_timeout + 5 * POLL, float(record["busy_until"]))


def _check_host(config: UrArmConfig, name: str) -> None:
    """A mock lives on loopback and nothing else does: neither may be taken for the other."""
    loopback = is_loopback(config.host)
    if config.mock is not None and not loopback:
        raise DeviceNotConnectedError(
            f"arm '{name}' has a `mock:` block, but its host {config.host} is outside this machine; a mock's host is a "
            "loopback address such as 127.0.0.2. Remove `mock:` to talk to the real arm"
        )
    if config.mock is None and loopback:
        raise DeviceNotConnectedError(
            f"arm '{name}' is a real one, but its host {config.host} is this machine; give its address, or add `mock: "
            "{}` for a mock controller"
        )


def _worker_config(config: UrArmConfig, name: str, segment: str, keep_out: Mapping[str, float]) -> WorkerConfig:
    limits, tool = config.limits, se3.to_matrix(config.flange_from_tool.pose)
    return WorkerConfig(
        name=name,
        host=config.host,
        model=config.model,
        refused_serial=MOCK_SERIAL if config.mock is None else None,
        realtime=config.mock is None or config.mock.realtime,
        parent=os.getpid(),
        segment=segment,
        world_from_base=se3.to_matrix(config.world_from_base.pose).tolist(),
        flange_from_tool=tool.tolist(),
        tool_from_sensor=se3.to_matrix(config.tool_from_sensor.pose).tolist(),
        tcp=pose(tool).tolist(),
        mass=config.payload.mass,
        mass_centre=list(config.payload.centre),
        lower=list(limits.workspace.lower),
        upper=list(limits.workspace.upper),
        planes=[[list(wall.point), list(wall.normal)] for wall in limits.planes],
        speed=limits.speed,
        turn_rate=limits.turn_rate,
        acceleration=limits.acceleration,
        turn_acceleration=limits.turn_acceleration,
        joint_speed=limits.joint_speed,
        force=limits.force,
        torque=limits.torque,
        depth=limits.depth,
        shear=limits.shear,
        link_timeout=config.link_timeout,
        action_timeout=config.action_timeout,
        observation_timeout=config.observation_timeout,
        watchdog=config.watchdog,
        lookahead=config.lookahead,
        gain=config.gain,
        partners=[Partner(shared_ring.segment_name(os.getpid(), other), gap) for other, gap in keep_out.items()],
    )

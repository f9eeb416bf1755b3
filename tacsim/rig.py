"""A rig: sensors, arms and a clock behind one contract. One code path for simulated, mock, real and replayed rigs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Protocol, Self

from tacsim.compute.threads import map_serial
from tacsim.interface import (
    Action,
    Arm,
    ArmState,
    Clock,
    Gripper,
    GripperState,
    GripperTarget,
    IncompatibleRig,
    Needs,
    Normaliser,
    Observation,
    Pose,
    RigSpec,
    TactileFrame,
    TactileObservation,
    TactileSource,
    Truth,
    View,
)
from tacsim.limits import check_action

if TYPE_CHECKING:
    from tacsim.control import LoadController
    from tacsim.record.episode import ArmPackages


READ_TIMEOUT = 1.0  # longest wait for a frame [s]


class Reset(Protocol):
    """Brings a rig to the start of an episode; `Rig.reset` calls `clear`, then `touch`."""

    def clear(self, seed: int) -> Mapping[str, TactileFrame]:
        """Takes the gels clear of everything; returns a frame of each sensor without contact, the references I0."""
        ...

    def touch(self) -> None:
        """Brings the gels into gentle contact with the body, where there is something to touch."""
        ...


class Rig:
    """What a policy acts on. It never asks what kind of sensors and arms it holds.

    Args:
        name: for messages and records.
        sensors, arms: by name.
        normalisers: one for each sensor.
        reset: brings the rig to the start of an episode.
        truth: the body as only a simulation knows it; None on rigs without.
        diagnostics: numbers about the last control step for the record, e.g. the settle residual.
        packages: what the controllers of the arms sent since the last call, for the record.
        read_all: how the sensors are read: one by one, or in parallel where that is faster (tacsim.compute.threads).
        on_tactile: called with every tactile observation before anybody acts on it; raises what ends the episode.
        on_close: closes the other resources of the rig, after sensors and arms.
        load_control: holds normal forces, whatever the actions ask along the z axis of the sensors.
        grippers: by name.
        views: of the cameras that look at the scene, by name; each gives what it sees now.
    """

    # By name; for calibration and inspection only.
    sensors: Mapping[str, TactileSource]
    arms: Mapping[str, Arm]
    grippers: Mapping[str, Gripper]
    normalisers: Mapping[str, Normaliser]  # by sensor
    # Native, by sensor; empty before the first.
    frames: Mapping[str, TactileFrame]  # of the last observation
    references: Mapping[str, TactileFrame]  # without contact, that the last reset took
    sent_grippers: Mapping[str, GripperTarget | None]  # what the last command really sent; None: nothing was executed

    def __init__(
        self,
        *,
        name: str,
        sensors: Mapping[str, TactileSource],
        arms: Mapping[str, Arm],
        clock: Clock,
        normalisers: Mapping[str, Normaliser],
        reset: Reset,
        truth: Callable[[], Truth | None] | None = None,
        diagnostics: Callable[[], Mapping[str, float]] = dict,
        packages: Callable[[], Mapping[str, ArmPackages]] = dict,
        read_all: Callable[[Sequence[Callable[[], TactileFrame]]], list[TactileFrame]] = map_serial,
        on_tactile: Callable[[Mapping[str, TactileObservation]], None] | None = None,
        on_close: Callable[[], None] | None = None,
        load_control: LoadController | None = None,
        grippers: Mapping[str, Gripper] | None = None,
        views: Mapping[str, Callable[[], View]] | None = None,
    ) -> None:
        if set(normalisers) != set(sensors):
            raise ValueError(f"rig '{name}': sensors {sorted(sensors)} but normalisers {sorted(normalisers)}")
        self.name = name
        self.sensors, self.arms, self.normalisers = dict(sensors), dict(arms), dict(normalisers)
        self.grippers, self.sent_grippers, self._views = dict(grippers or {}), {}, dict(views or {})
        self._clock, self._reset, self._truth, self._diagnostics = clock, reset, truth, diagnostics
        self._read_all, self._load_control, self._packages = read_all, load_control, packages
        self._on_tactile, self._on_close = on_tactile, on_close
        self._arm_states: Mapping[str, ArmState] = {}
        self._closed = False
        self.frames = self.references = {}
        specs = {sensor: source.spec for sensor, source in sensors.items()}
        self.spec = RigSpec(
            specs, tuple(arms), truth is not None, clock.period, tuple(self.grippers), tuple(self._views)
        )
        # A sensor that no arm carries may be addressed by its own name: the action is recorded, nothing moves.
        self._addressable = set(arms) | {
            sensor for sensor, spec in specs.items() if spec.arm is None and spec.gripper is None
        }

    def require(self, needs: Needs, requester: str) -> None:
        """Raises IncompatibleRig with the difference when `requester` needs what this rig does not deliver."""
        require_needs(self.name, self.spec, needs, requester)

    def reset(self, seed: int = 0) -> Observation:
        """Starts an episode: references without contact, then gentle contact. The same seed gives the same start. A
        reset that fails leaves the arms stopped."""
        with self._stop_all_on_failure():
            self.references = dict(self._reset.clear(seed))
            for name, normaliser in self.normalisers.items():
                normaliser.take_reference(self.references[name])
            self._reset.touch()
        if self._load_control is not None:
            self._load_control.reset()
        return self.observe()

    def observe(self) -> Observation:
        """The newest tactile observations, the states that the arms had when those pictures were exposed, and the
        newest ones of the grippers.

        Raises TimeoutError without a frame, EndOfEpisode after a recording.
        """
        reads = [partial(sensor.read, READ_TIMEOUT) for sensor in self.sensors.values()]
        frames = dict(zip(self.sensors, self._read_all(reads), strict=True))
        exposed = {self.sensors[name].spec.arm: frame.time for name, frame in frames.items()}
        arms: dict[str, ArmState] = {name: arm.state(exposed.get(name)) for name, arm in self.arms.items()}
        grippers: dict[str, GripperState] = {name: gripper.state() for name, gripper in self.grippers.items()}
        now = self._clock.now()
        tactile = {name: self.normalisers[name](frame, now) for name, frame in frames.items()}
        self.frames, self._arm_states = frames, arms
        if self._on_tactile is not None:
            self._on_tactile(tactile)
        views = {name: read() for name, read in self._views.items()}
        return Observation(tactile=tactile, arms=arms, time=now, grippers=grippers, views=views)

    def step(self, action: Action) -> tuple[Observation, Mapping[str, Pose | None]]:
        """One control period: commands arms and grippers, lets the clock run, observes.

        Returns the observation and what each arm was really sent (None: nothing was executed); what the grippers were
        sent is in `sent_grippers`.
        Raises ActionError for an action that this rig cannot take, RuntimeError once it is closed, whatever observe
        raises, and SimulationDiverged. An arm that cannot follow stops the others.
        """
        sent = self.command(action)
        self.tick()
        return self.observe(), sent

    def command(self, action: Action) -> Mapping[str, Pose | None]:
        """The first part of a step: commands arms and grippers; returns and raises as `step`."""
        check_action(action, self._addressable, self.name, self.grippers)
        if self._load_control is not None:
            action = self._load_control(action, self._arm_states)
        with self._stop_all_on_failure():
            sent = {name: arm.command(action.tool.get(name)) for name, arm in self.arms.items()}
            self.sent_grippers = {
                name: gripper.command(action.grippers.get(name)) for name, gripper in self.grippers.items()
            }
        if self._load_control is not None:
            self._load_control.record_sent_poses(sent)
        return sent

    def tick(self) -> None:
        """The second part of a step: lets the clock run one period. Raises SimulationDiverged."""
        self._clock.tick()

    @property
    def clock(self) -> Clock:
        """What `tick` lets run; for inspection only."""
        return self._clock

    def now(self) -> float:
        """The time on the rig's clock [s]."""
        return self._clock.now()

    def packages(self) -> Mapping[str, ArmPackages]:
        """What the controllers of the arms sent since the last call, by arm; of those whose packages are recorded."""
        return self._packages()

    def truth(self) -> Truth | None:
        """The body as only a simulation knows it; for tasks, never for policies."""
        return None if self._truth is None else self._truth()

    def diagnostics(self) -> Mapping[str, float]:
        """Numbers about the last control step, e.g. the residual of the simulation's settling; those of a sensor, such
        as `stale_upper`, end in its name."""
        found = dict(self._diagnostics())
        for name, normaliser in self.normalisers.items():
            found |= {f"{key}_{name}": value for key, value in normaliser.diagnostics().items()}
        return found

    def stop(self) -> None:
        """Stops all arms and grippers, each even when another fails to stop."""
        _call_all([*(arm.stop for arm in self.arms.values()), *(gripper.stop for gripper in self.grippers.values())])

    def close(self) -> None:
        """Stops all arms and grippers, then closes everything, each even when another fails. A step in another thread
        ends."""
        self._closed = True
        moving: list[Arm | Gripper] = [*self.arms.values(), *self.grippers.values()]
        arms = [*(part.stop for part in moving), *(part.close for part in moving)]
        others = [] if self._on_close is None else [self._on_close]
        _call_all([*arms, *(sensor.close for sensor in self.sensors.values()), *others])

    @contextmanager
    def _stop_all_on_failure(self) -> Iterator[None]:
        """No arm goes on when something fails that concerns all of them, or when the rig was closed at the same time: a
        motion commanded after its stop is stopped here."""
        try:
            self._require_open()
            yield
            self._require_open()
        except BaseException:
            with suppress(Exception):  # what failed first is raised
                self.stop()
            raise

    def _require_open(self) -> None:
        if self._closed:
            raise RuntimeError(f"rig '{self.name}' is closed; open it again")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def require_needs(rig: str, spec: RigSpec, needs: Needs, requester: str, advice: str = "") -> None:
    """Raises IncompatibleRig with the difference, and `advice`, if the rig does not deliver what `requester` needs."""
    missing = needs.missing(spec)
    if missing:
        has = f"sensors {', '.join(spec.sensors)}; arms {', '.join(spec.arms) or '(none)'}"
        has += f"; grippers {', '.join(spec.grippers)}" if spec.grippers else ""
        words = f"{requester} cannot run on rig '{rig}': it lacks {'; '.join(missing)}. It has {has}"
        raise IncompatibleRig(f"{words}. {advice}" if advice else words)


def _call_all(calls: list[Callable[[], None]]) -> None:
    """Runs all calls, then raises what failed; also when they are interrupted: every arm must get its stop."""
    failures: list[BaseException] = []
    for call in calls:
        try:
            call()
        except BaseException as failure:
            failures.append(failure)
    for each in failures:
        if len(failures) == 1 or not isinstance(each, Exception):
            raise each
    if failures:
        raise BaseExceptionGroup("several parts of the rig failed to stop or close", failures)

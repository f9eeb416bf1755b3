"""Simulated time: each period drives the world's frames to where the arms were commanded."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Generic, Protocol, TypeVar

from tacsim import pose as se3
from tacsim.interface import FloatArray, Pose
from tacsim.models.rig import SimMotion
from tacsim.physics.move import MoveCommand, MoveStats
from tacsim.physics.world import World

Value = TypeVar("Value")


class StateClock(Protocol):
    """Simulated time as sensors and arms see it."""

    period: float  # [s]
    periods: int  # since time zero
    episode: int  # the seed of the noise
    version: int  # counts the states of the world
    velocities: Mapping[str, FloatArray]  # by frame, see SimClock

    def now(self) -> float: ...
    def command(self, frame: str, pose: Pose, limited: bool) -> None: ...
    def commanded(self, frame: str) -> Pose | None: ...
    def drop_commands(self) -> None: ...
    def diagnostics(self) -> Mapping[str, float]: ...


class Delayed(Generic[Value]):
    """The observation of `delay` periods ago; in the first periods of an episode, the first one."""

    def __init__(self, delay: int) -> None:
        self._past: deque[Value] = deque(maxlen=delay + 1)
        self._version = -1

    def __call__(self, clock: StateClock, observe: Callable[[], Value]) -> Value:
        """`observe` is called once for each state of the world."""
        if self._version != clock.version or not self._past:
            if clock.now() == 0.0:
                self._past.clear()
            self._past.append(observe())
            self._version = clock.version
        return self._past[0]

    def clear(self) -> None:
        self._past.clear()


class SimClock:
    """Simulated time. `tick` drives every frame to its commanded pose and advances time by one period.

    `motion`: "settled": each period ends at rest; "flowing": frames pass their targets at speed, and the world comes to
    rest once no command is given any more; "dynamic": each period takes its own time, with true inertia
    (tacsim.physics.motion.inertia).
    `version` counts the states of the world, so that each state is rendered once.
    """

    def __init__(self, world: World, period: float, motion: SimMotion = "settled") -> None:
        self._world = world
        self.period = period  # [s]
        self._motion = motion
        self._targets: dict[str, Pose] = {}
        self._limited: dict[str, bool] = {}  # by frame: a guard changed the last command
        self._before: dict[str, Pose] = {}  # where the frames were that move in this period
        self._time = 0.0
        self.periods = 0  # since time zero
        self.episode = 0  # the seed of the noise
        self.version = 0
        self.stats: MoveStats | None = None  # of the last motion
        self._diagnostics: tuple[int, Mapping[str, float]] = -1, {}  # version, and those of it
        # (6,) by frame: mean of the last period, world axes [m/s, rad/s]
        self.velocities: Mapping[str, FloatArray] = {}

    def now(self) -> float:
        return self._time

    def command(self, frame: str, pose: Pose, limited: bool) -> None:
        """Sets the pose of `frame` at the end of the period; `limited`: a guard has changed the command."""
        self._targets[frame] = pose
        self._limited[frame] = limited

    def commanded(self, frame: str) -> Pose | None:
        """The pose of `frame` at the end of this period; None if nothing was commanded."""
        return self._targets.get(frame)

    def drop_commands(self) -> None:
        """Forgets the commands of this period."""
        self._targets = {}

    def tick(self) -> None:
        """One period. A world at rest without commands is left as it is. Raises SimulationDiverged."""
        command = self.begin()
        self.finish(
            None if command is None else self._world.move(command.targets, duration=command.duration, flow=command.flow)
        )

    def begin(self) -> MoveCommand | None:
        """Takes the commands of this period; returns the motion that they ask for, None for a world that rests. Who
        carries it out says so by `finish`, as `tick` does; if it fails, the period does not pass."""
        targets, self._targets = self._targets, {}
        self._before = {frame: self._world.pose(frame) for frame in targets}
        if self._motion == "dynamic":
            return MoveCommand(targets, duration=self.period)
        if targets or (self.stats is not None and not self.stats.settled):
            return MoveCommand(targets, flow=self._motion == "flowing")
        return None

    def finish(self, stats: MoveStats | None) -> None:
        """The period is over: its motion went like `stats`, or there was none."""
        if stats is not None:
            self.stats = stats
        elif self.stats is not None:
            self.stats = replace(self.stats, substeps=0, hold=0)
        self.velocities = {
            frame: se3.pose_difference(old, self._world.pose(frame)) / self.period
            for frame, old in self._before.items()
        }
        self._time += self.period
        self.periods += 1
        self.version += 1

    def restart(self, stats: MoveStats | None = None, episode: int | None = None) -> None:
        """Time zero, in a world whose state was restored. `episode`: of another one, the seed of its noise."""
        self._time, self._targets, self._limited, self.velocities, self.stats = 0.0, {}, {}, {}, stats
        self.periods, self.episode = 0, self.episode if episode is None else episode
        self.version += 1

    def diagnostics(self) -> Mapping[str, float]:
        """The MoveStats of the last motion, and `shortened`: how many commands the limits changed."""
        stats = self.stats
        if stats is None:
            return {}
        if self._diagnostics[0] != self.version:  # each sensor asks for them, and so does the rig
            found = {each.name: float(getattr(stats, each.name)) for each in fields(stats)}
            self._diagnostics = self.version, {**found, "shortened": float(sum(self._limited.values()))}
        return self._diagnostics[1]

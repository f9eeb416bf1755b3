"""One frame of a simulated world as an arm."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from typing import Protocol

import numpy as np

from tacsim import pose as se3
from tacsim.interface import ArmState, FloatArray, Pose
from tacsim.limits import LimitExceeded, clip_to_region, exceeds_wrench, limit_step
from tacsim.models.limits import ArmLimits
from tacsim.models.rig import WrenchNoise
from tacsim.sim.clock import Delayed, StateClock
from tacsim.sim.mount import ElasticMount


class FrameWorld(Protocol):
    """A simulated world as an arm sees it."""

    @property
    def sensors(self) -> tuple[str, ...]:
        """The frames that feel a wrench."""
        ...

    def pose(self, name: str) -> Pose: ...
    def wrench(self, name: str) -> FloatArray: ...


class WrenchNoiseSource:
    """What an arm's force sensor adds to the wrench: noise of each reading, and a zero that wanders.

    It follows from the seed of `noise`, the arm, the episode and the period alone.
    """

    def __init__(self, noise: WrenchNoise, arm: str) -> None:
        self._deviation = np.repeat([noise.force, noise.torque], 3)
        self._drift = noise.drift
        self._key = (noise.seed, zlib.crc32(arm.encode()))
        self._begin(0)

    def _begin(self, episode: int) -> None:
        self._episode, self._index = episode, -1
        self._generator = np.random.default_rng((*self._key, episode))
        self._reading, self._step, self._zero = np.zeros(6), np.zeros(6), np.zeros(6)

    def __call__(self, index: int, period: float, episode: int) -> FloatArray:
        """(6,) in period `index` from 0, each of `period` [s]; force [N], then torque [N m]."""
        minute = 60.0  # [s]
        if episode != self._episode or index < self._index:
            self._begin(episode)
        while self._index < index:
            self._index += 1
            self._zero = self._zero + self._step
            self._reading, self._step = self._generator.standard_normal((2, 6))
        zero = self._drift * np.sqrt(period / minute) * self._zero
        noise: FloatArray = self._deviation * (self._reading + zero)
        return noise


def wrench_noise_source(noise: WrenchNoise, arm: str) -> WrenchNoiseSource | None:
    """Of the arm of this name; None for a sensor without noise."""
    return WrenchNoiseSource(noise, arm) if noise.force or noise.torque else None


class SimArm:
    """Carries one frame of the world (a sensor, a gripper, or "indenter") to its commanded pose.

    Args:
        max_step, max_turn: longest motion of one control period [m, rad]; longer ones are shortened, and counted.
        limits: guards the arm as a real one is guarded (robot.arm.ur), by the same functions: targets are shortened at
            the faces of its workspace, and too much force or torque stops it. None: no guard.
        keep_out: frames to stay away from, and how far [m]; targets are shortened at these spheres.
        error: measured pose of its frame, relative to the true one; None: no error.
        delay: its states are those of so many periods ago.
        noise: of its force sensor, in what it reports; its guard feels the force itself. None: no noise.
    """

    def __init__(
        self,
        world: FrameWorld,
        clock: StateClock,
        frame: str,
        max_step: float,
        max_turn: float,
        limits: ArmLimits | None = None,
        keep_out: Iterable[tuple[str, float]] = (),
        error: Pose | None = None,
        delay: int = 0,
        noise: WrenchNoiseSource | None = None,
    ) -> None:
        self._world, self._clock, self.frame = world, clock, frame
        self._max_step, self._max_turn = max_step, max_turn
        self._limits, self._keep_out = limits, tuple(keep_out)
        self._region = None if limits is None else limits.region
        self._mount: ElasticMount | None = None
        self._opposite: tuple[str, ...] = ()
        self.set_measurement_errors(error, delay, noise)

    def set_mount(self, mount: ElasticMount | None, opposite: Iterable[str] = ()) -> None:
        """What holds the frame to the arm, from the next episode on; None: it is rigid. A mount belongs to one arm.

        opposite: frames of the other arms, which press against this one.
        """
        self._mount, self._opposite = mount, tuple(opposite)

    def set_measurement_errors(self, error: Pose | None, delay: int, noise: WrenchNoiseSource | None = None) -> None:
        """Another error, delay and noise, from the next episode on."""
        self._error, self._past, self._noise = error, Delayed[ArmState](delay), noise

    def state(self, at: float | None = None) -> ArmState:
        """The state now, or `delay` periods ago. Simulated pictures and arms are of one instant, so `at` makes no
        difference."""
        return self._past(self._clock, self._state)

    def _state(self) -> ArmState:
        if self._mount is not None and self._clock.periods == 0:
            self._mount.begin()
        wrench = self._wrench()
        if self._error is not None:
            wrench = se3.transform_wrench(se3.inverse(self._error), wrench)
        if self._noise is not None:
            wrench = wrench + self._noise(self._clock.periods, self._clock.period, self._clock.episode)
        return ArmState(
            pose=self._measured_pose(),
            twist=self._clock.velocities.get(self.frame, np.zeros(6)).copy(),
            wrench=wrench,
            joints=self._joints(),
            time=self._clock.now(),
        )

    def _joints(self) -> FloatArray | None:
        """(n,) [rad]; None without joints."""
        return None

    def _measured_pose(self) -> Pose:
        here = self._world.pose(self.frame)
        if self._mount is not None:
            here = Pose(self._mount.arm_position(here.position, self._world_force()), here.quaternion)
        return here if self._error is None else se3.compose(here, self._error)

    def _world_force(self) -> FloatArray:
        """(3,) on the frame, world axes [N]."""
        return se3.rotate(self._world.pose(self.frame), self._wrench()[:3])

    def _wrench(self) -> FloatArray:
        """(6,) on the sensor; on the indenter, the reaction of all sensors. About its origin, in its axes [N, N m]."""
        world = self._world
        if self.frame in world.sensors:
            return np.array(world.wrench(self.frame), dtype=np.float64)
        here = world.pose(self.frame)
        parts = [
            se3.transform_wrench(se3.relative_pose(here, world.pose(name)), world.wrench(name))
            for name in world.sensors
        ]
        reaction: FloatArray = -np.sum(parts, axis=0)
        return reaction

    def command(self, target: Pose | None) -> Pose | None:
        """Takes effect at the next tick; None holds. Returns the pose after the limits. Raises LimitExceeded."""
        self._check_wrench()
        if target is None:
            if self._mount is not None:  # it goes on giving way
                self._command_frame(self.true_pose(self._measured_pose()), limited=False)
            return None
        measured = self._measured_pose()
        allowed, _ = clip_to_region(target, measured, self._region, self._spheres())
        allowed = limit_step(allowed, measured, self._max_step, self._max_turn)
        self._command_frame(self.true_pose(allowed), limited=allowed is not target)
        return allowed

    @property
    def has_error(self) -> bool:
        """Its measured pose differs from the true one."""
        return self._error is not None

    def true_pose(self, measured: Pose) -> Pose:
        """Where the arm holds the frame if it measures this pose."""
        return measured if self._error is None else se3.compose(measured, se3.inverse(self._error))

    def _command_frame(self, arm: Pose, limited: bool) -> None:
        """Moves the frame to where it is once the arm holds it at `arm`."""
        if self._mount is not None:
            here = self._world.pose(self.frame).position
            opposite = [self._world.pose(frame).position for frame in self._opposite]
            arm = Pose(self._mount.move_arm(arm.position, here, self._world_force(), opposite), arm.quaternion)
        self._clock.command(self.frame, arm, limited=limited)

    def stop(self) -> None:
        self._clock.drop_commands()

    def recover(self) -> None:
        """Drops its command; an arm that feels too much stays stopped as long as it does."""
        self.stop()

    def _spheres(self) -> list[tuple[FloatArray, float]]:
        """Around the frames to stay away from: where they are, and where they are commanded to."""
        return [
            (pose.position, distance)
            for frame, distance in self._keep_out
            for pose in (self._world.pose(frame), self._clock.commanded(frame))
            if pose is not None
        ]

    def _check_wrench(self) -> None:
        limits = self._limits
        if limits is None:
            return
        wrench = self._wrench()
        if exceeds_wrench(wrench, limits.force, limits.torque):
            self.stop()
            force, torque = np.linalg.norm(wrench.reshape(2, 3), axis=1)
            raise LimitExceeded(
                f"arm of '{self.frame}' felt more than limits.force or limits.torque and stopped ({force:.1f} of "
                f"{limits.force:g} N, {torque:.2f} of {limits.torque:g} N m); begin a new episode, or move the other "
                "sensor away"
            )

    def close(self) -> None:
        """Nothing is held open."""

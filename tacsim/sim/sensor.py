"""The simulator behind the contract: one World seen as sensors, arms and a clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim import pose as se3
from tacsim.interface import ArmState, FloatArray, Pose, SensorSpec, SurfaceMap, TactileFrame, Truth
from tacsim.limits import LimitExceeded, clip_to_region, exceeds_wrench, limit_step
from tacsim.models.hardware import ArmLimits
from tacsim.models.rig import SimMotion
from tacsim.models.scene import GelSurface
from tacsim.optics.noise import NoiseSource
from tacsim.physics.world import MoveStats, World

CLEARANCE = 0.05e-3  # gap that the first, fast part of an approach leaves [m]
FIRST_STEP = 0.1e-3  # of the slow part [m]
TOUCH_TOLERANCE = 0.2  # the touch force may be exceeded by this fraction
MOST_MOVES = 80  # of one approach
SMALLEST_STEP = 1e-8  # an approach that needs finer steps has met something that never gives a gentle force [m]


class NoTouch(RuntimeError):
    """The approach at reset found no gentle contact."""


class SimClock:
    """Simulated time. `tick` drives all arms to what they were commanded and advances time by one period.

    `motion`: "settled": each period ends in the state of rest; "flowing": frames pass what they were commanded to at
    speed, and rest is waited for once nothing is commanded any more; "dynamic": each period is lived through in its own
    time, by true inertia (tacsim.physics.motion.inertia).
    `version` counts the states of the world, so that a picture is rendered once a state.
    """

    def __init__(self, world: World, period: float, motion: SimMotion = "settled") -> None:
        self._world = world
        self._period = period
        self._motion = motion
        self._targets: dict[str, Pose] = {}
        self._limited: dict[str, bool] = {}  # by frame, of the last period
        self._time = 0.0
        self.version = 0
        self.stats: MoveStats | None = None  # of the last tick that moved
        self.velocities: Mapping[str, FloatArray] = {}  # (6,) mean of the last period, world axes [m/s, rad/s]

    @property
    def period(self) -> float:
        return self._period

    def now(self) -> float:
        return self._time

    def target(self, frame: str, pose: Pose, limited: bool) -> None:
        """Where `frame` shall be at the end of the period, and whether a guard has changed that."""
        self._targets[frame] = pose
        self._limited[frame] = limited

    def asked(self, frame: str, otherwise: Pose) -> Pose:
        """Where `frame` was told to be at the end of this period; `otherwise` if it was not."""
        return self._targets.get(frame, otherwise)

    def forget(self) -> None:
        """Drops what was commanded and not yet driven."""
        self._targets = {}

    def tick(self) -> None:
        """Raises SimulationDiverged. A world at rest that is commanded to stay is left as it is."""
        targets, self._targets = self._targets, {}
        before = {frame: self._world.pose(frame) for frame in targets}
        if self._motion == "dynamic":
            self.stats = self._world.move(targets, duration=self._period)
        elif targets or (self.stats is not None and not self.stats.settled):
            self.stats = self._world.move(targets, flow=self._motion == "flowing")
        elif self.stats is not None:
            self.stats = replace(self.stats, substeps=0, hold=0)
        self.velocities = {
            frame: se3.difference(old, self._world.pose(frame)) / self._period for frame, old in before.items()
        }
        self._time += self._period
        self.version += 1

    def restart(self, stats: MoveStats | None = None) -> None:
        """Time zero, with a world that was put there from outside."""
        self._time, self._targets, self._limited, self.velocities, self.stats = 0.0, {}, {}, {}, stats
        self.version += 1

    def diagnostics(self) -> Mapping[str, float]:
        """How the last move went, all of tacsim.physics.world.MoveStats, and how many targets the limits
        shortened."""
        stats = self.stats
        if stats is None:
            return {}
        told = {name: float(value) for name, value in asdict(stats).items()}
        return told | {"shortened": float(sum(self._limited.values()))}


class SimArm:
    """Carries one frame of the world (a sensor, or "indenter") exactly where it is told.

    `longest` [m] and `widest` [rad] bound the motion of one control period; what is beyond is shortened, and counted.
    With `limits` it is guarded as a real arm is (robot.arm.ur), by the same functions: targets are shortened at its
    walls and at the spheres round the frames `apart` (frame, distance [m]), and too much force or torque stops it.
    """

    def __init__(
        self,
        world: World,
        clock: SimClock,
        frame: str,
        longest: float,
        widest: float,
        limits: ArmLimits | None = None,
        apart: Iterable[tuple[str, float]] = (),
    ) -> None:
        self._world, self._clock, self._frame = world, clock, frame
        self._longest, self._widest = longest, widest
        self._limits, self._apart = limits, tuple(apart)
        self._region = None if limits is None else limits.region

    def state(self, at: float | None = None) -> ArmState:
        """Pictures and arms are of one instant in simulation, so `at` makes no difference."""
        return ArmState(
            pose=self._world.pose(self._frame),
            twist=self._clock.velocities.get(self._frame, np.zeros(6)).copy(),
            wrench=self._wrench(),
            joints=None,
            time=self._clock.now(),
        )

    def _wrench(self) -> FloatArray:
        """On the sensor; on a tool without one (the indenter) the reaction of all sensors."""
        world = self._world
        if self._frame in world.sensors:
            return np.array(world.wrench(self._frame), dtype=np.float64)
        here = world.pose(self._frame)
        parts = [
            se3.transform_wrench(se3.relative(here, world.pose(name)), world.wrench(name)) for name in world.sensors
        ]
        reaction: FloatArray = -np.sum(parts, axis=0)
        return reaction

    def command(self, target: Pose | None) -> Pose | None:
        """Takes effect at the next tick; None holds. Returns the pose after the limits. Raises LimitExceeded."""
        self._feel()
        if target is None:
            return None
        now, allowed = self._world.pose(self._frame), target
        if self._region is not None or self._apart:
            allowed, _ = clip_to_region(target, now, self._region, self._spheres())
        allowed = limit_step(allowed, now, self._longest, self._widest)
        self._clock.target(self._frame, allowed, limited=allowed is not target)
        return allowed

    def stop(self) -> None:
        self._clock.forget()

    def recover(self) -> None:
        """Drops what was asked; an arm that feels too much stays stopped as long as it does."""
        self.stop()

    def _spheres(self) -> list[tuple[FloatArray, float]]:
        """Where the frames to stay away from are, and where they go in this period as far as that is known."""
        spheres = []
        for frame, distance in self._apart:
            here = self._world.pose(frame)
            spheres += [(here.position, distance), (self._clock.asked(frame, here).position, distance)]
        return spheres

    def _feel(self) -> None:
        limits = self._limits
        if limits is None:
            return
        wrench = self._wrench()
        if exceeds_wrench(wrench, limits.force, limits.torque):
            self.stop()
            force, torque = np.linalg.norm(wrench.reshape(2, 3), axis=1)
            raise LimitExceeded(
                f"arm of '{self._frame}' felt more than limits.force or limits.torque and stopped ({force:.1f} of "
                f"{limits.force:g} N, {torque:.2f} of {limits.torque:g} N m); begin a new episode, or move the other "
                "sensor away"
            )

    def close(self) -> None:
        """Nothing is held open."""


class SimSensor:
    """One simulated tactile sensor; a picture is rendered only when it is read, and once a state of the world.

    Args:
        render: gel surface -> (H, W, 3) uint8 RGB.
        sample: gel surface -> height, gradient and flow on the canonical grid.
        noise: of its camera; that of a picture follows from the episode's seed and the frame's index. None: none.
    """

    def __init__(
        self,
        world: World,
        clock: SimClock,
        frame: str,
        spec: SensorSpec,
        render: Callable[[GelSurface], NDArray[np.uint8]],
        sample: Callable[[GelSurface], SurfaceMap],
        noise: NoiseSource | None = None,
    ) -> None:
        self._world, self._clock, self._frame, self._spec = world, clock, frame, spec
        self._render, self._sample, self._noise = render, sample, noise
        self._newest: TactileFrame | None = None
        self._version = -1  # of the world in the newest frame
        self._index = self._episode = 0

    @property
    def spec(self) -> SensorSpec:
        return self._spec

    def read(self, timeout: float) -> TactileFrame:
        """The picture of the world as it is now; simulation never times out."""
        if self._newest is None or self._version != self._clock.version:
            surface = self._world.surface(self._frame)
            image = self._render(surface)
            if self._noise is not None:
                image = self._noise(image, self._index, self._episode)
            self._newest = TactileFrame(
                image=image,
                time=self._clock.now(),
                index=self._index,
                surface=self._sample(surface),
                stats=self._clock.diagnostics(),
            )
            self._version, self._index = self._clock.version, self._index + 1
        return self._newest

    def restart(self, episode: int = 0) -> None:
        """Counts frames from zero again; `episode`: seed of the noise in this one."""
        self._newest, self._index, self._episode = None, 0, episode

    def close(self) -> None:
        """Nothing is held open."""


class SimReset:
    """Start of a simulated episode: the world's initial state, and the approach to gentle contact.

    Args:
        touch_force: normal force that ends the approach [N]; None leaves the gels clear.
        placement: the gels start at most this far beside the body in world x and y, drawn from the seed [m].
    """

    def __init__(
        self,
        world: World,
        clock: SimClock,
        sensors: Mapping[str, SimSensor],
        touch_force: float | None,
        placement: float = 0.0,
    ) -> None:
        self._world, self._clock, self._sensors = world, clock, sensors
        self._touch_force, self._placement = touch_force, placement
        self._initial = world.snapshot()
        self._offset = np.zeros(2)
        # The last approach: where it started from, and the state it ended in. The same start gives the same end.
        self._touched: tuple[FloatArray, Mapping[str, NDArray[Any]], MoveStats | None] | None = None

    def clear(self, seed: int) -> Mapping[str, TactileFrame]:
        self._world.restore(self._initial)
        self._offset = self._placement * np.random.default_rng(seed).uniform(-1.0, 1.0, size=2)
        if self._offset.any():
            shift = np.append(self._offset, 0.0)
            poses = {name: self._world.pose(name) for name in self._world.sensors}
            self._world.move({name: Pose(pose.position + shift, pose.quaternion) for name, pose in poses.items()})
        self._clock.restart()
        for sensor in self._sensors.values():
            sensor.restart(seed)
        return {name: sensor.read(0.0) for name, sensor in self._sensors.items()}

    def touch(self) -> None:
        """Raises NoTouch when no gentle contact is found."""
        if self._touch_force is None:
            return
        if self._touched is None or not np.array_equal(self._touched[0], self._offset):
            stats = approach(self._world, self._touch_force)
            self._touched = (self._offset, self._world.snapshot(), stats)
        else:
            self._world.restore(self._touched[1])
        self._clock.restart(self._touched[2])


def approach(world: World, touch_force: float) -> MoveStats | None:
    """Moves all sensors along their own z towards the body until the least normal force reaches `touch_force` [N].

    A fast part closes the gaps that are known; then come small steps. A motion that presses harder than
    touch_force * (1 + TOUCH_TOLERANCE) is taken back, state and all, so that the body keeps no trace of it, and bounds
    the steps that follow. Returns how the last move went, None if there was none. Raises NoTouch.
    """
    most = touch_force * (1 + TOUCH_TOLERANCE)
    stats = _close_gaps(world, most)
    way, too_far = 0.0, math.inf  # how far the sensors have come, and what would be too far [m]
    felt = [(way, _least_force(world))]  # (way, force) of every state tried
    step = 0.0
    for _ in range(MOST_MOVES):
        if felt[-1][0] == way and felt[-1][1] >= touch_force:
            return stats
        step = _aim(felt, way, too_far, touch_force * (1 + TOUCH_TOLERANCE / 2)) - way
        if step < SMALLEST_STEP:
            break
        before = world.snapshot()
        stats = _advance(world, dict.fromkeys(world.sensors, step))
        felt.append((way + step, _least_force(world)))
        if felt[-1][1] > most:
            world.restore(before)
            too_far = way + step
        else:
            way += step
    raise NoTouch(
        f"approach found no gentle contact: normal force {felt[-1][1]:.4g} N, {touch_force:.4g} N wanted, after "
        f"{len(felt) - 1} moves, the last by {step:.3g} m. Is there a body between the gels, and is touch_force within "
        "what the scene's settling tolerance resolves?"
    )


def _aim(felt: list[tuple[float, float]], way: float, too_far: float, wanted: float) -> float:
    """How far [m] the force `wanted` [N] is to be expected: on the line through the last two states in contact; with
    one such state, contact is taken to begin half-way to it. Kept between `way` and `too_far`."""
    farthest = min(too_far, way + FIRST_STEP)
    touching = [(x, force) for x, force in felt if force > 0][-2:]
    if not touching:
        return farthest
    x, force = touching[-1]
    if len(touching) == 2 and (force - touching[0][1]) * (x - touching[0][0]) > 0:
        aim = x + (wanted - force) * (x - touching[0][0]) / (force - touching[0][1])
    else:
        aim = way + (x - way) * (0.5 + 0.5 * wanted / force) if force > wanted else farthest
    margin = 0.05 * (farthest - way)
    return min(max(aim, way + margin), farthest if too_far > farthest else farthest - margin)


def _close_gaps(world: World, most: float) -> MoveStats | None:
    """Drives each sensor to CLEARANCE before the body's nearest particle, where a body is known and there is a gap.

    Taken back if it presses harder than `most` [N]: on a shared grid, contact begins at a distance.
    """
    truth = world.truth()
    if truth is None:
        return None
    gaps = {name: _gap(truth, world.pose(name)) - CLEARANCE for name in world.sensors}
    wanted = {name: gap for name, gap in gaps.items() if gap > 0}
    if not wanted:
        return None
    before = world.snapshot()
    stats = _advance(world, wanted)
    if _least_force(world) > most:
        world.restore(before)
        return None
    return stats


def _gap(truth: Truth, sensor: Pose) -> float:
    """From the gel's rest surface to the nearest face of the body, along the sensor's z [m]."""
    points = truth.points.astype(np.float64)
    radius = 0.5 * (truth.height - float(np.ptp(points[:, 2])))
    axis = se3.rotation(sensor).as_matrix()[:, 2]
    return float(((points - sensor.position) @ axis).min()) - radius


def _advance(world: World, steps: Mapping[str, float]) -> MoveStats:
    """Moves each named sensor along its own z by its step [m]."""
    forward = {name: Pose(np.array([0.0, 0.0, step])) for name, step in steps.items()}
    return world.move({name: se3.compose(world.pose(name), move) for name, move in forward.items()})


def _least_force(world: World) -> float:
    """Smallest normal force over the sensors, positive when pressed [N]."""
    return min(-float(world.wrench(name)[2]) for name in world.sensors)

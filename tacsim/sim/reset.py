"""How a simulated episode begins: the initial state of the world, then the approach to gentle contact."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping

import numpy as np

from tacsim import pose as se3
from tacsim.control import NoTouch
from tacsim.interface import Pose, TactileFrame, Truth
from tacsim.models.scene import Scene
from tacsim.physics.move import MoveStats
from tacsim.physics.world import World
from tacsim.sim.arm import SimArm
from tacsim.sim.clock import SimClock
from tacsim.sim.scene_world import SceneWorld, StatePool
from tacsim.sim.sensor import SimSensor
from tacsim.sim.tuning import APPROACH_GAP, FIRST_TOUCH_STEP, MAX_STEP, TOUCH_TOLERANCE


class SimReset:
    """Starts a simulated episode: the world as it was made, with each arm where it measures its start, then an approach
    until gentle contact. An approach that was made before, in the same scene from the same poses, is not made again.

    Args:
        arms: of the rig. As on a robot, an arm with an error of its pose measures that it is at its start, and is not.
        touch_force: normal force that ends the approach [N]; None leaves the gels clear.
        placement: the gels start at most this far from the body in world x and y, drawn from the seed [m].
        pool: of touched states; of this reset alone, or of several.
    """

    def __init__(
        self,
        scene_world: SceneWorld,
        clock: SimClock,
        sensors: Mapping[str, SimSensor],
        arms: Mapping[str, SimArm],
        touch_force: float | None,
        placement: float = 0.0,
        pool: StatePool | None = None,
    ) -> None:
        self._scene_world, self._clock, self._sensors, self._arms = scene_world, clock, sensors, arms
        self._touch_force, self._placement = touch_force, placement
        self._pool = StatePool() if pool is None else pool
        self._starts: dict[str, Pose] = {}  # of frames that do not begin where the scene has them

    def clear(self, seed: int) -> Mapping[str, TactileFrame]:
        scene_world = self._scene_world
        scene_world.rewind()
        arms, sensors = self._arms.values(), scene_world.sensors
        self._starts = find_starts(scene_world.pose, arms, sensors, self._placement, seed)
        if self._starts:
            self._starts = _keep_clear(scene_world, self._starts)
            scene_world.place(self._starts)
        self._clock.restart(episode=seed)
        for sensor in self._sensors.values():
            sensor.restart(seed)
        return {name: sensor.read(0.0) for name, sensor in self._sensors.items()}

    def touch(self) -> None:
        """Raises NoTouch when no gentle contact is found."""
        if self._touch_force is None:
            return
        start = start_key(self._scene_world.scene, self._starts, self._touch_force)
        touched = self._pool.find(start)
        if touched is None:
            stats = approach_force(self._scene_world, self._touch_force)
            self._pool.store(start, self._scene_world.snapshot(), stats)
        else:
            self._scene_world.restore(touched[0])
            stats = touched[1]
        self._clock.restart(stats)


def find_starts(
    pose: Callable[[str], Pose], arms: Iterable[SimArm], shifted: Collection[str], placement: float, seed: int
) -> dict[str, Pose]:
    """By frame, of those that do not begin at `pose(frame)`, where the scene has them: frames in `shifted` by at most
    `placement` [m] along world x and y, drawn from the seed, and those of arms with an error."""
    offset = placement * np.random.default_rng(seed).uniform(-1.0, 1.0, size=2)
    starts: dict[str, Pose] = {}
    if offset.any():
        starts = {name: Pose(pose(name).position + [*offset, 0.0], pose(name).quaternion) for name in shifted}
    for arm in arms:
        if arm.has_error:
            starts[arm.frame] = arm.true_pose(starts.get(arm.frame) or pose(arm.frame))
    return starts


def _keep_clear(world: World, starts: Mapping[str, Pose]) -> dict[str, Pose]:
    """Starts before which sensors have at least the gap of the scene, which is small: where an error takes a sensor
    nearer to what it will touch, it begins as much farther back along its own z."""
    truth, kept = world.truth(), dict(starts)
    for name in set(starts).intersection(world.sensors):
        here, there = world.pose(name), starts[name]
        if truth is None:
            nearer = float(se3.relative_position(here, there)[2])
        else:
            nearer = _gap_to_body(truth, here) - _gap_to_body(truth, there)
        if nearer > 0.0:
            kept[name] = se3.translated_along_z(there, -nearer)
    return kept


def start_key(scene: Scene, starts: Mapping[str, Pose], touch_force: float) -> tuple[object, ...]:
    """Equal for episodes that begin alike."""
    poses = [(name, *pose.position.tolist(), *pose.quaternion.tolist()) for name, pose in starts.items()]
    return scene.model_dump_json(), *poses, touch_force  # numbers: -0.0 is 0.0


def approach_force(world: World, touch_force: float) -> MoveStats | None:
    """Moves all sensors along their own z until the least normal force is at least `touch_force` [N].

    Known gaps are closed at once; small steps follow. A step after which a force exceeds
    touch_force * (1 + TOUCH_TOLERANCE) is undone by restoring the world, so that the body keeps no trace of it, and its
    end bounds the steps that follow. Returns how the last move went, None if there was none. Raises NoTouch.
    """
    max_moves = 80  # of one approach
    min_step = 1e-8  # an approach that needs finer steps has met something that never gives a gentle force [m]
    max_force = touch_force * (1 + TOUCH_TOLERANCE)
    begins, stats = _close_gaps(world, max_force), None
    here, bound = 0.0, math.inf  # travelled by each sensor; where the force is too large [m]
    tried = [(here, _min_force(world))]  # (distance, force) of every state tried
    step = 0.0
    for _ in range(max_moves):
        if tried[-1][0] == here and tried[-1][1] >= touch_force:
            return stats
        step = _next_distance(tried, here, bound, touch_force * (1 + TOUCH_TOLERANCE / 2), begins) - here
        if step < min_step:
            break
        before = world.snapshot()
        stats = _advance_sensors(world, dict.fromkeys(world.sensors, step))
        tried.append((here + step, _min_force(world)))
        if tried[-1][1] > max_force:
            world.restore(before)
            bound = here + step
        else:
            here += step
    raise NoTouch(
        f"approach found no gentle contact: normal force {tried[-1][1]:.4g} N, {touch_force:.4g} N wanted, after "
        f"{len(tried) - 1} moves, the last by {step:.3g} m. Is there a body between the gels, and is touch_force "
        "within what the scene's settling tolerance resolves?"
    )


def _next_distance(
    tried: list[tuple[float, float]], here: float, bound: float, desired: float, begins: float | None
) -> float:
    """The distance [m] at which the force `desired` [N] is expected, between `here` and `bound`: on the secant through
    the last two states in contact. One of them may be that in which contact `begins`; where that is not known, it is
    taken to be half-way to the first state in contact."""
    farthest = min(bound, here + MAX_STEP)
    contacts = [(distance, force) for distance, force in tried if force > 0][-2:]
    if not contacts:
        return farthest if begins is None or here > 0.0 else min(farthest, begins + FIRST_TOUCH_STEP)
    if len(contacts) == 1 and begins is not None and contacts[0][0] > begins:
        contacts.insert(0, (begins, 0.0))
    x, force = contacts[-1]
    if len(contacts) == 2 and (force - contacts[0][1]) * (x - contacts[0][0]) > 0:
        aim = x + (desired - force) * (x - contacts[0][0]) / (force - contacts[0][1])
    else:
        aim = here + (x - here) * (0.5 + 0.5 * desired / force) if force > desired else farthest
    margin = 0.01 * (farthest - here)
    return min(max(aim, here + margin), farthest if bound > farthest else farthest - margin)


def _close_gaps(world: World, max_force: float) -> float | None:
    """Puts each sensor at APPROACH_GAP before the body's nearest particle, if there is a body and a gap.

    Returns how far from there contact begins [m], None where that is not known. Undone if the force exceeds
    `max_force` [N]: on a shared grid, contact begins at a distance.
    """
    truth = world.truth()
    if truth is None:
        return None
    gaps = {name: _gap_to_body(truth, world.pose(name)) - APPROACH_GAP for name in world.sensors}
    desired = {name: gap for name, gap in gaps.items() if gap > 0}
    if not desired:
        return None
    before = world.snapshot()
    world.place({name: se3.translated_along_z(world.pose(name), gap) for name, gap in desired.items()})
    if _min_force(world) > max_force:
        world.restore(before)
        return None
    return APPROACH_GAP if len(desired) == len(gaps) else None


def _gap_to_body(truth: Truth, sensor: Pose) -> float:
    """From the gel's rest surface to the nearest face of the body, along the sensor's z [m]."""
    points = truth.points.astype(np.float64)
    radius = 0.5 * (truth.height - float(np.ptp(points[:, 2])))
    axis = se3.rotation_matrix(sensor)[:, 2]
    return float(((points - sensor.position) @ axis).min()) - radius


def _advance_sensors(world: World, steps: Mapping[str, float]) -> MoveStats:
    """Moves each named sensor along its own z by its step [m]."""
    return world.move({name: se3.translated_along_z(world.pose(name), step) for name, step in steps.items()})


def _min_force(world: World) -> float:
    """Smallest normal force over the sensors, positive when pressed [N]."""
    return min(-float(world.wrench(name)[2]) for name in world.sensors)

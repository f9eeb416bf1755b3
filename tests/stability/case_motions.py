"""Motions of the hard cases: what drives a world from one state to the next."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping

from scipy.spatial.transform import Rotation

from tacsim.interface import Pose
from tacsim.physics.world import World
from tacsim.physics.worlds.tuning import INITIAL_GAP

Targets = Mapping[str, Pose]
Motions = Callable[[World], Iterator[Targets]]


def by(world: World, name: str, x: float = 0.0, y: float = 0.0, z: float = 0.0, turn: float = 0.0) -> Targets:
    """The frame moved by (x, y, z) [m] and turned about world z [rad]."""
    pose = world.pose(name)
    spun = Rotation.from_rotvec([0, 0, turn]) * Rotation.from_quat(pose.quaternion)
    return {name: Pose(pose.position + [x, y, z], spun.as_quat())}


def together(world: World, distance: float) -> Targets:
    """Both sensors towards each other by `distance` [m] in all."""
    return {**by(world, "lower", z=distance / 2), **by(world, "upper", z=-distance / 2)}


def gap(world: World) -> float:
    """Between the gels' rest surfaces [m]."""
    return float(world.pose("upper").position[2] - world.pose("lower").position[2])


def squeeze_to(share: float, steps: int = 4, within: float = 0.0) -> Motions:
    """Until the gap is `share` of the body's height (plus `within` [m] of gel that gives), in equal steps."""

    def motions(world: World) -> Iterator[Targets]:
        truth = world.truth()
        assert truth is not None
        way = gap(world) - share * truth.height + within
        for _ in range(steps):
            yield together(world, way / steps)

    return motions


def squeeze_by(distance: float, steps: int = 2) -> Motions:
    """Beyond first touch by `distance` [m]."""

    def motions(world: World) -> Iterator[Targets]:
        truth = world.truth()
        assert truth is not None
        way = gap(world) - truth.height + distance
        for _ in range(steps):
            yield together(world, way / steps)

    return motions


def push(depth: float, steps: int = 1) -> Motions:
    """Indenter to `depth` [m] below the untouched surface."""

    def motions(world: World) -> Iterator[Targets]:
        for _ in range(steps):
            yield by(world, "indenter", z=-(depth + INITIAL_GAP) / steps)

    return motions


def rest(substeps: int) -> Motions:
    """Holds in small pieces, as many as it takes."""

    def motions(world: World) -> Iterator[Targets]:
        del world
        for _ in range(substeps // 40):
            yield {}

    return motions


def then(*parts: Motions) -> Motions:
    def motions(world: World) -> Iterator[Targets]:
        for part in parts:
            yield from part(world)

    return motions


def through(world: World) -> Iterator[Targets]:
    """The upper sensor through the body into the lower gel."""
    yield by(world, "upper", z=-gap(world) - 2e-3)


def regrasp(world: World) -> Iterator[Targets]:
    """In moves 1 and 2, release in move 3, and in move 4 as far as in move 2."""
    yield from squeeze_by(0.8e-3)(world)
    for distance in (-3e-3, 3e-3):
        yield together(world, distance)


def twist(world: World) -> Iterator[Targets]:
    if world.truth() is None:
        yield from push(0.5e-3)(world)
        frame = "indenter"
    else:
        yield from squeeze_by(0.8e-3)(world)
        frame = "upper"
    for _ in range(3):
        yield by(world, frame, turn=math.radians(20))


def mark(world: World) -> Iterator[Targets]:
    """From here on drift counts."""
    name = world.sensors[0]
    yield {name: world.pose(name)}


def shear(world: World) -> Iterator[Targets]:
    yield by(world, "upper", x=0.2e-3)


def drag(world: World) -> Iterator[Targets]:
    """The upper sensor sideways, while the body yields, until it slides."""
    for _ in range(3):
        yield by(world, "upper", x=1.0e-3)


def impact(world: World) -> Iterator[Targets]:
    """In real time, by the true densities, at a peak speed of 0.28 of the gel's pressure wave; then at rest.

    A rigid indenter at half of that: it throws the surface ahead of it, beyond the limit of half the wave's speed.
    """
    way, duration = 1.5e-3, 0.28e-3
    if world.truth() is None:
        yield from push(0.0)(world)
        world.move(by(world, "indenter", z=-way), duration=2 * duration)
    else:
        yield from squeeze_by(0.0)(world)
        world.move(together(world, 2 * way), duration=duration)
    yield {}


def flow_about(world: World) -> Iterator[Targets]:
    """Steps that flow into one another, each against the one before, while the gap closes; then at rest."""
    frame = "indenter" if world.truth() is None else "upper"
    yield from (push(0.3e-3) if world.truth() is None else squeeze_by(0.5e-3))(world)
    for step in range(12):
        sign = -1.0 if step % 2 else 1.0
        world.move(by(world, frame, x=sign * 0.3e-3, z=-0.02e-3, turn=sign * 0.05), flow=True)
    yield {}


def over_the_rim(world: World) -> Iterator[Targets]:
    yield {**by(world, "lower", x=4e-3), **by(world, "upper", x=4e-3)}
    yield from squeeze_by(1.2e-3)(world)


def poison(name: str, value: float = math.nan) -> Motions:
    """Puts a number into the first entry of an array, and goes on."""

    def motions(world: World) -> Iterator[Targets]:
        frame = "indenter" if world.truth() is None else "upper"
        yield by(world, frame, z=-0.5e-3)
        array = world.arrays()[name]  # type: ignore[attr-defined]
        array[(0,) * array.ndim] = value
        yield by(world, frame, z=-0.1e-3)

    return motions


def escape(world: World) -> Iterator[Targets]:
    """A particle 100 m away: no grid can follow."""
    arrays = world.arrays()  # type: ignore[attr-defined]
    for place in {"position", "reference"} & set(arrays):  # in space, and on the grid of `physics: hybrid`
        arrays[place][-1] = [1e5, 1e5, 0.0]
    yield {}

"""The hard cases, run in a worker process (case_worker): each a scene and a list of motions, by name.

A case ends `finite` (a sound state, whose numbers are in `facts`), `diverged` (SimulationDiverged, and the world is bit
for bit as before the motion and still of use) or `refused` (ValueError). Anything else is a failure of the case.
"""

from __future__ import annotations

import math
import os
import struct
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from scipy.spatial.transform import Rotation

from tacsim.interface import Pose
from tacsim.models.scene import (
    Body,
    BodyMaterial,
    Box,
    Cylinder,
    Gel,
    GelMaterial,
    Indenter,
    Mesh,
    Scene,
    Settling,
    Sphere,
)
from tacsim.physics import snapshot
from tacsim.physics.failure import diagnosis
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.move import MoveStats
from tacsim.physics.seed import world as seed_world
from tacsim.physics.world import World, make_world
from tacsim.physics.worlds import hybrid, press
from tacsim.physics.worlds.base import RETRIES

Targets = Mapping[str, Pose]
Motions = Callable[[World], Iterator[Targets]]

GEL = Gel(size=(10e-3, 10e-3, 4e-3))
WIDE = Gel(size=(16e-3, 16e-3, 2e-3), material=GelMaterial(youngs_modulus=10e6, poisson_ratio=0.3), housing=None)
CLAY = BodyMaterial(yield_stress=30e3)
QUICK = Settling(mach=0.1, tolerance=1e-2, max_substeps=600)


BOTH, PRESS = ("hybrid", "seed"), ("press",)


@dataclass(frozen=True)
class Outcome:
    kind: str  # finite, diverged, refused
    words: str = ""
    figures: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Case:
    scene: Callable[[str], Scene]
    motions: Motions
    physics: tuple[str, ...] = BOTH
    patch: Mapping[str, Any] = field(default_factory=dict)  # module attribute -> value


# ------------------------------------------------------------------ scenes


def cube(
    side: float = 4e-3, material: BodyMaterial = CLAY, size: tuple[float, float, float] | None = None, **more: Any
):
    """A scene with a body, for any physics that simulates one."""

    def scene(physics: str) -> Scene:
        geometry = Box(size=size or (side, side, side))
        return Scene(
            **{"gel": GEL, "settling": QUICK, **more}, physics=physics, body=Body(geometry=geometry, material=material)
        )

    return scene


def indented(geometry: Any, **more: Any):
    """A scene with an indenter on a gel."""

    def scene(_: str) -> Scene:
        made = geometry() if callable(geometry) else geometry
        return Scene(**{"gel": GEL, "settling": QUICK, **more}, body=None, indenter=Indenter(geometry=made))

    return scene


def scaled(factor: float):
    """10 mm gels round a 4 mm cube, all lengths times `factor`."""
    size = tuple(factor * a for a in GEL.size)
    lengths = {"particle_spacing": factor * 0.5e-3, "element_size": factor * 1e-3}
    return cube(factor * 4e-3, gel=Gel(size=size, housing=None), **lengths)


def cone() -> Mesh:
    """A sharp cone, 3 mm high, 60 degrees at its tip, which points down; written as a binary STL file."""
    n, radius, height = 32, 3e-3 * math.tan(math.radians(30)) * 1e3, 3.0
    ring = [(radius * math.cos(2 * math.pi * i / n), radius * math.sin(2 * math.pi * i / n), height) for i in range(n)]
    tip, top = (0.0, 0.0, 0.0), (0.0, 0.0, height)
    facets = [(tip, ring[(i + 1) % n], ring[i]) for i in range(n)] + [
        (top, ring[i], ring[(i + 1) % n]) for i in range(n)
    ]
    data = b"".join(struct.pack("<12fH", 0, 0, 0, *(x for corner in facet for x in corner), 0) for facet in facets)
    path = Path(tempfile.mkdtemp()) / "cone.stl"
    path.write_bytes(bytes(80) + struct.pack("<I", len(facets)) + data)
    return Mesh(path=str(path))


# ------------------------------------------------------------------ motions


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
            yield by(world, "indenter", z=-(depth + press.CLEARANCE) / steps)

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
    world.arrays()["position"][-1] = [1e5, 1e5, 0.0]  # type: ignore[attr-defined]
    yield {}


def poisoned(name: str, times: int) -> Callable[..., Any]:
    """The function `name` of snapshot, which worlds call with their arrays before a launch, puts a NaN into a velocity.

    Before the 3rd launch, and before the ones after it: `times` in all.
    """
    launches = 0

    def spoilt(arrays: Mapping[str, np.ndarray], *others: Any) -> Any:
        nonlocal launches
        launches += 1
        if 3 <= launches < 3 + times:
            velocity = arrays.get("velocity", arrays.get("gel_velocity"))
            assert velocity is not None
            velocity[(0,) * velocity.ndim] = math.nan
        return getattr(snapshot, name)(arrays, *others)

    return spoilt


def with_nan(times: int) -> dict[str, Any]:
    return {"hybrid.copies": times, "press.copies": times, "seed.copies": times}


SHORT = {"hybrid.COURANT": 0.3, "press.COURANT": 0.3, "seed.COURANT": 0.3}
TOO_LONG = {"hybrid.COURANT": 1.2, "press.COURANT": 1.2, "seed.COURANT": 1.5}
RUSHED = Settling(mach=0.1, tolerance=1e-2, max_substeps=600, flow_mach=0.3)
USUAL = Settling(tolerance=1e-2, max_substeps=600)
SLOWER = Settling(mach=0.05, tolerance=1e-2, max_substeps=600)
BALL = indented(Sphere(radius=4e-3))
SMALL = cube(3e-3, gel=Gel(size=(8e-3, 8e-3, 4e-3)))
ALWAYS = RETRIES + 1  # once in every attempt

CASES: dict[str, Case] = {
    # materials at their limits
    "elastic, nu 0.45, to half": Case(cube(material=BodyMaterial(poisson_ratio=0.45), gel=WIDE), squeeze_to(0.5)),
    "elastic, nu 0.49, to half": Case(cube(material=BodyMaterial(poisson_ratio=0.49), gel=WIDE), squeeze_to(0.5)),
    "elastic, nu 0.499, to half": Case(cube(material=BodyMaterial(poisson_ratio=0.499), gel=WIDE), squeeze_to(0.5)),
    "plasticine, k 0.01, to a tenth": Case(
        cube(material=BodyMaterial(yield_strain=0.01), gel=WIDE), squeeze_to(0.1, 8)
    ),
    "plasticine, k 0.05, to a fifth": Case(
        cube(material=BodyMaterial(yield_strain=0.05), gel=WIDE), squeeze_to(0.2, 8)
    ),
    "hardly any yield stress": Case(cube(material=BodyMaterial(yield_stress=1.0)), squeeze_by(1.0e-3)),
    "body 10,000 times stiffer": Case(cube(material=BodyMaterial(youngs_modulus=1.45e9)), squeeze_by(1.0e-3)),
    "gel 10,000 times stiffer": Case(cube(material=BodyMaterial(youngs_modulus=14.5)), squeeze_by(1.0e-3)),
    "gel to a tenth, plate": Case(indented(Box(size=(20e-3, 20e-3, 4e-3))), push(3.6e-3, 4), PRESS),
    "gel to a tenth, punch": Case(indented(Cylinder(radius=2e-3, height=8e-3)), push(3.6e-3, 4), PRESS),
    # shapes and sizes
    "one layer of particles": Case(cube(size=(4e-3, 4e-3, 0.5e-3)), squeeze_by(0.4e-3)),
    "scene of 0.1 mm": Case(scaled(0.01), squeeze_to(0.8)),
    "scene of 10 mm": Case(scaled(1.0), squeeze_to(0.8)),
    "scene of 1 m": Case(scaled(100.0), squeeze_to(0.8)),
    "sharp cone": Case(indented(cone), push(1.0e-3, 2), PRESS),
    "sharp cone, deep": Case(indented(cone), push(2.9e-3, 2), PRESS),
    # motions
    "Mach 0.3": Case(cube(settling=Settling(mach=0.3)), squeeze_by(2.0e-3, 1)),
    "Mach 0.3, press": Case(indented(Sphere(radius=4e-3), settling=Settling(mach=0.3)), push(1.5e-3), PRESS),
    "impact, elastic": Case(cube(material=BodyMaterial()), impact, ("hybrid",)),
    "impact, plastic": Case(cube(), impact, ("hybrid",)),
    "impact, press": Case(BALL, impact, PRESS),
    "flow, back and forth": Case(cube(), flow_about, ("hybrid",)),
    "flow, back and forth, fast": Case(cube(settling=RUSHED), flow_about, ("hybrid",)),
    "flow, back and forth, press": Case(BALL, flow_about, PRESS),
    "flow, back and forth, fast, press": Case(indented(Sphere(radius=4e-3), settling=RUSHED), flow_about, PRESS),
    "yield and slide": Case(cube(), then(squeeze_by(1.2e-3), drag)),
    "sensor through the body": Case(cube(), through),
    "indenter through the gel": Case(BALL, push(5e-3), PRESS),
    "body over the rim": Case(cube(), over_the_rim),
    "body over the rim, no housing": Case(cube(gel=Gel(size=GEL.size, housing=None)), over_the_rim, ("hybrid",)),
    "release and grasp again": Case(cube(settling=USUAL), regrasp),
    "twist": Case(cube(), twist),
    "twist, press": Case(indented(Box(size=(4e-3, 4e-3, 4e-3))), twist, PRESS),
    # rest
    "unstressed rest": Case(SMALL, rest(4_000), ("hybrid",)),
    "unstressed rest, short": Case(SMALL, rest(800), ("seed",)),
    "unstressed rest, press": Case(BALL, rest(4_000), PRESS),
    "unstressed rest, long": Case(SMALL, rest(30_000)),
    "unstressed rest, long, press": Case(BALL, rest(30_000), PRESS),
    "loaded rest": Case(SMALL, then(squeeze_by(0.6e-3), shear, rest(400), mark, rest(2_000)), ("hybrid",)),
    "loaded rest, short": Case(SMALL, then(squeeze_by(0.6e-3), shear, rest(400), mark, rest(400)), ("seed",)),
    "loaded rest, press": Case(BALL, then(push(0.8e-3), rest(400), mark, rest(2_000)), PRESS),
    "loaded rest, long": Case(SMALL, then(squeeze_by(0.6e-3), shear, rest(400), mark, rest(100_000)), ("hybrid",)),
    # numbers and steps
    "step limit kept": Case(cube(settling=SLOWER), squeeze_by(1.0e-3)),
    "short steps": Case(cube(settling=SLOWER), squeeze_by(1.0e-3), patch=SHORT),
    "short steps, press": Case(BALL, push(0.8e-3, 3), PRESS, SHORT),
    "step limit violated": Case(cube(settling=SLOWER), squeeze_by(1.0e-3), patch=TOO_LONG),
    "step limit kept, press": Case(BALL, push(0.8e-3, 3), PRESS),
    "step limit violated, press": Case(BALL, push(0.8e-3, 3), PRESS, TOO_LONG),
    **{f"NaN in {name}": Case(cube(), poison(name)) for name in ("position", "velocity")},
    **{f"NaN in {name}": Case(cube(), poison(name), ("hybrid",)) for name in ("strain", "gel_displacement")},
    **{f"NaN in {name}": Case(cube(), poison(name), ("seed",)) for name in ("deformation_gradient", "stress")},
    "NaN in gel_velocity": Case(BALL, poison("gel_velocity"), PRESS),
    "infinite velocity": Case(cube(), poison("velocity", math.inf)),
    "a NaN on the way": Case(cube(), squeeze_by(1.0e-3, 1), patch=with_nan(1)),
    "a NaN on the way, press": Case(BALL, push(0.8e-3), PRESS, with_nan(1)),
    "NaNs all the way": Case(cube(), squeeze_by(1.0e-3, 1), patch=with_nan(ALWAYS)),
    "NaNs all the way, press": Case(BALL, push(0.8e-3), PRESS, with_nan(ALWAYS)),
    "a particle far away": Case(cube(), escape),
}


# ------------------------------------------------------------------ running


def run(name: str, physics: str) -> Outcome:
    """One case from a new world on. Raises AssertionError where the world breaks its promises."""
    if name == "death":  # for the tests of the worker itself
        os.abort()
    while name == "endless":
        time.sleep(1.0)
    case = CASES[name]
    modules = {"hybrid": hybrid, "press": press, "seed": seed_world}
    with ExitStack() as stack:
        for target, value in case.patch.items():
            module, _, attribute = target.partition(".")
            if attribute == "copies":
                value = poisoned(attribute, value)
            stack.enter_context(mock.patch.object(modules[module], attribute, value))
        try:
            world = make_world(case.scene("seed" if physics == "seed" else "hybrid"))
            return _driven(world, case.motions)
        except ValueError as refusal:
            return Outcome("refused", str(refusal))


def _driven(world: World, motions: Motions) -> Outcome:
    stats: list[MoveStats] = []
    moves: dict[str, float] = {}
    first: np.ndarray | None = None
    for targets in motions(world):
        before = world.snapshot()
        try:
            stats.append(world.move(targets))
        except SimulationDiverged as failure:
            _assert_rolled_back(world, before, failure)
            return Outcome("diverged", str(failure), {"moves": len(stats)})
        _assert_consistent(world, stats[-1], targets)
        moves |= _after_move(world, len(stats))
        if targets or first is None:
            first = _shape(world)
    drift = 0.0 if first is None else float(np.abs(_shape(world) - first).max())
    return Outcome("finite", "", {**moves, **_facts(world, stats), "drift": drift})


def _after_move(world: World, number: int) -> dict[str, float]:
    """Largest force on a sensor [N], and largest displacement of a gel's surface [m]."""
    return {
        f"force {number}": max(float(np.linalg.norm(world.wrench(name)[:3])) for name in world.sensors),
        f"dent {number}": max(float(np.abs(world.surface(name).displacement).max()) for name in world.sensors),
    }


def _shape(world: World) -> np.ndarray:
    """What must not drift at rest: body particles and gel surfaces [m]."""
    truth = world.truth()
    parts = [] if truth is None else [truth.points.ravel()]
    return np.concatenate([*parts, *(world.surface(name).displacement.ravel() for name in world.sensors)])


def _assert_rolled_back(world: World, before: Mapping[str, np.ndarray], failure: SimulationDiverged) -> None:
    after = world.snapshot()
    changed = [name for name in before if before[name].tobytes() != after[name].tobytes()]
    assert not changed, f"after divergence {changed} are not as before the motion"
    assert failure.cause and failure.where and failure.advice
    assert failure.cause in str(failure) and failure.advice in str(failure)
    if all(np.isfinite(a).all() for a in before.values()) and "spread over" not in failure.cause:
        world.move({})  # the world is still of use
        assert all(np.isfinite(a).all() for a in world.snapshot().values())


def _assert_consistent(world: World, stats: MoveStats, targets: Targets) -> None:
    settling = world.scene.settling  # type: ignore[attr-defined]
    assert 0 <= stats.hold <= min(stats.substeps, settling.max_substeps)
    assert stats.settled == (stats.residual <= settling.tolerance)
    assert stats.residual >= 0 and stats.overlap >= 0 and stats.guard_hits >= 0 and 0 <= stats.retries <= RETRIES
    for name, pose in targets.items():
        assert np.allclose(world.pose(name).position, pose.position, atol=1e-12)
    assert all(np.isfinite(a).all() for a in world.snapshot().values())
    for name in world.sensors:
        assert np.isfinite(world.wrench(name)).all() and np.isfinite(world.surface(name).displacement).all()


def _facts(world: World, stats: list[MoveStats]) -> dict[str, float]:
    state, truth = world.snapshot(), world.truth()
    figures = {
        "force": -float(world.wrench("lower")[2]),
        "torque": float(world.wrench("lower")[5]),
        "settled": float(stats[-1].settled),
        "residual": stats[-1].residual,
        "gap": gap(world) if truth is not None else math.nan,
        "overlap": max(s.overlap for s in stats),
        "substeps": float(sum(s.substeps for s in stats)),
        "retries": float(sum(s.retries for s in stats)),
        "guard_hits": float(sum(s.guard_hits for s in stats)),
    }
    volumes = diagnosis.particle_volumes(state)
    elements = diagnosis.element_volumes(state, world.scene.gel.size[2] * 1e3)  # type: ignore[attr-defined]
    for name, values in (("particle", volumes), ("element", elements)):
        if values is not None:
            figures |= {f"least {name}": float(values.min()), f"most {name}": float(values.max())}
    if truth is not None:
        figures |= {
            "height": truth.height,
            "x": float(truth.position[0]),
            "upper force": -float(world.wrench("upper")[2]),
            "upper torque": float(world.wrench("upper")[5]),
        }
    return figures

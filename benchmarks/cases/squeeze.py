"""Squeeze group: a plasticine cube between two gels, against the slow limit of the same mesh, and against symmetry."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np

from benchmarks.harness.cache import cached
from benchmarks.harness.measure import Measurement, Timing, timed
from benchmarks.harness.runner import Case
from benchmarks.truth.gap import gaps
from benchmarks.truth.roughness import print_roughness
from tacsim.compute.threads import map_parallel
from tacsim.interface import Pose
from tacsim.models.material import BodyMaterial
from tacsim.models.scene import Body, Box, Preset, Scene, Settling
from tacsim.physics.move import MoveStats
from tacsim.physics.world import World, make_world

if TYPE_CHECKING:
    from tacsim.interface import FloatArray

SQUEEZE = 3e-3  # both sensors together, from first contact [m]
STEP, STEPS = 0.1e-3, 20  # both sensors together in a control step [m]; number of steps
TOUCH = 0.05e-3  # first indentation of each gel, which makes contact certain [m]
SLOW = {"mach": 0.003, "tolerance": 1e-3, "max_substeps": 100_000}
NOT_SETTLED = {"max_substeps": 0}


def squeeze_scene(preset: str, physics: str = "hybrid", **settling: float) -> Scene:
    """The shipped scene: cube of 10 mm, two gels of 20 x 20 x 4 mm, friction 0.6."""
    from tacsim.config import load_scene

    overrides = [f"preset={preset}", f"physics={physics}", *(f"settling.{k}={v}" for k, v in settling.items())]
    return load_scene("squeeze", overrides)


def world_in_contact(scene: Scene) -> World:
    """A new world at rest whose gels just touch the body."""
    world = make_world(scene)
    truth = world.truth()
    assert truth is not None
    gap = float(world.pose("upper").position[2]) - truth.height
    close_sensors(world, gap + 2 * TOUCH)
    return world


def closing_targets(world: World, by: float) -> dict[str, Pose]:
    """Targets of both sensors, closer to each other by `by` [m] in total."""
    targets = {}
    for name, sign in (("lower", 1.0), ("upper", -1.0)):
        pose = world.pose(name)
        targets[name] = Pose(pose.position + [0.0, 0.0, sign * by / 2], pose.quaternion)
    return targets


def close_sensors(world: World, by: float, *, flow: bool = False) -> MoveStats:
    """Moves both sensors towards each other, by `by` [m] in total."""
    return world.move(closing_targets(world, by), flow=flow)


def normal_forces(world: World) -> FloatArray:
    """[N] of lower and upper sensor, positive when pressed."""
    return np.array([-float(world.wrench(name)[2]) for name in world.sensors])


def slow_force(preset: str, physics: str = "hybrid") -> float:
    """Force [N] after a squeeze at a speed without influence, on the same mesh. Takes minutes at `standard`; cached."""
    scene = squeeze_scene(preset, physics, **SLOW)

    def compute() -> list[float]:
        world = world_in_contact(scene)
        stats = close_sensors(world, SQUEEZE)
        if not stats.settled:
            raise RuntimeError(f"the slow squeeze did not settle: residual {stats.residual:.2g}")
        return [float(normal_forces(world).mean())]

    return cached(f"squeeze-{preset}-{physics}", scene.model_dump_json(), compute)[0]


def squeeze(preset: str, physics: str, repeat: int) -> list[Measurement]:
    """3 mm from first contact: the motion only, then settled to 1 %."""
    truth = slow_force(preset, physics)
    rows = []
    for settling, name in ((NOT_SETTLED, "not settled"), ({}, "settled to 1 %")):
        start = world_in_contact(squeeze_scene(preset, physics))
        world = make_world(squeeze_scene(preset, physics, **settling))
        world.restore(start.snapshot())
        rows += _squeeze_rows(world, truth, name, repeat)
    return rows


def _squeezed_again(world: World, repeat: int) -> tuple[Timing, MoveStats]:
    """A timed squeeze of 3 mm from the state of `world`, which ends in the state after the last repetition."""
    begin = world.snapshot()

    def run() -> MoveStats:
        world.restore(begin)
        return close_sensors(world, SQUEEZE)

    return timed(run, repeat, warm=lambda: None)  # `world_in_contact` has used every kernel already


def _squeeze_rows(world: World, truth: float, variant: str, repeat: int) -> list[Measurement]:
    from tacsim.physics.worlds.hybrid import HybridWorld

    timing, stats = _squeezed_again(world, repeat)
    forces = normal_forces(world)
    held = stats.hold > 0
    mean, gap = float(forces.mean()), abs(float(forces[0] - forces[1]))
    figures = {"force_n": mean, "truth_n": truth}
    if held:
        figures["residual"] = stats.residual
    note = "" if stats.settled or not held else f"not settled within {stats.hold} substeps of hold"
    rows = [
        Measurement(
            timing, abs(mean / truth - 1) * 100, "% of force", "same mesh, Mach 0.003, tolerance 1e-3", variant,
            stats.substeps, figures, note,
        )
    ]  # fmt: skip
    if not held:
        return rows
    rows.append(
        Measurement(
            timing, gap / mean * 100, "% imbalance", "equal forces on both sensors", "force balance",
            stats.substeps, {"lower_n": float(forces[0]), "upper_n": float(forces[1])}, note,
        )
    )  # fmt: skip
    if isinstance(world, HybridWorld):  # bodies on one grid have neither overlap nor gap
        between = gaps(world, world.scene.spacing)
        rows.append(
            Measurement(
                timing, stats.overlap * 1e3, "mm overlap", "no overlap of body and gel", "overlap", stats.substeps,
                {}, note,
            )
        )  # fmt: skip
        rows.append(
            Measurement(
                timing, between.gap * 1e3, "mm gap", "no gap of body and gel inside the contact (truth/gap.py)",
                "gap", stats.substeps, {"overlap_mm": between.overlap * 1e3, "rim_mm": between.rim * 1e3}, note,
            )
        )  # fmt: skip
    return rows


def settled_squeeze(preset: str, physics: str, repeat: int) -> list[Measurement]:
    """3 mm from first contact, settled to 1 %: every method against one truth, the slow limit of our `standard` mesh.
    Our row with that mesh has no error of the mesh; the bodies of seed stick where ours have friction.
    """
    truth = slow_force("standard")
    world = world_in_contact(squeeze_scene(preset, physics))
    timing, stats = _squeezed_again(world, repeat)
    force = float(normal_forces(world).mean())
    figures = {"force_n": force, "truth_n": truth}
    return [
        Measurement(
            timing, abs(force / truth - 1) * 100, "% of force", "tacsim at `standard`, Mach 0.003, tolerance 1e-3",
            "one truth for all", stats.substeps, figures, "" if stats.settled else "not settled",
        )
    ]  # fmt: skip


def control_step(preset: str, physics: str, repeat: int) -> list[Measurement]:
    """0.1 mm of motion in the middle of a squeeze, and both images of 320 x 240: settled, the default, and flowing."""
    truth = slow_steps(preset, physics)
    kinds = (False, True) if physics == "hybrid" else (False,)
    return [_control_step_row(preset, physics, truth, flow, repeat) for flow in kinds]


def _control_step_row(preset: str, physics: str, truth: FloatArray, flow: bool, repeat: int) -> Measurement:
    from tacsim.config import load_sensor
    from tacsim.optics.render import Renderer

    scene = squeeze_scene(preset, physics)
    sensor = load_sensor("ideal", ["geometry.width=320", "geometry.height=240"])
    camera = Renderer(sensor, scene.gel.size[:2])
    world = _squeezed(scene)
    forces = [_force_after_a_step(world, flow) for _ in range(STEPS // 2)]
    begin = world.snapshot()  # in motion, if it flows

    def run() -> MoveStats:
        world.restore(begin)
        stats = close_sensors(world, STEP, flow=flow)
        map_parallel([partial(camera, world.surface(name)) for name in world.sensors])
        return stats

    timing, stats = timed(run, repeat)
    forces.append(float(normal_forces(world).mean()))
    forces += [_force_after_a_step(world, flow) for _ in range(STEPS - len(forces))]
    errors = np.abs(np.array(forces) / truth - 1) * 100
    figures = {"first_step_percent": float(errors[0]), "worst_percent": float(errors.max())}
    return Measurement(
        timing, float(np.sqrt(np.mean(errors**2))), "% of force", f"rms of {STEPS} steps, each settled at Mach 0.003",
        "0.1 mm, flowing, and two images" if flow else "0.1 mm, settled, and two images", stats.substeps,
        {**figures, "residual": stats.residual}, "" if stats.settled or flow else "not settled",
    )  # fmt: skip


def _squeezed(scene: Scene) -> World:
    """A world squeezed by 1 mm from first contact, at a speed without influence."""
    slow = world_in_contact(squeeze_scene(scene.preset, scene.physics, **{**SLOW, "mach": 0.01}))
    close_sensors(slow, 1e-3)
    world = make_world(scene)
    world.restore(slow.snapshot())
    return world


def _force_after_a_step(world: World, flow: bool) -> float:
    close_sensors(world, STEP, flow=flow)
    return float(normal_forces(world).mean())


def slow_steps(preset: str, physics: str) -> FloatArray:
    """Forces [N] after each of STEPS steps at a speed without influence; cached."""
    scene = squeeze_scene(preset, physics, **SLOW)

    def compute() -> list[float]:
        world = _squeezed(scene)
        return [_force_after_a_step(world, flow=False) for _ in range(STEPS)]

    return np.array(cached(f"steps-{preset}-{physics}", scene.model_dump_json(), compute))


def reposition(preset: str, physics: str, repeat: int) -> list[Measurement]:
    """Pressed 0.5 mm, then the upper sensor moves 3 mm along x: by symmetry the body ends half-way."""
    displacement = 3e-3
    world = world_in_contact(squeeze_scene(preset, physics))
    close_sensors(world, 0.5e-3)
    begin = world.snapshot()
    centre = world.truth()
    pose = world.pose("upper")

    def run() -> MoveStats:
        world.restore(begin)
        return world.move({"upper": Pose(pose.position + [displacement, 0.0, 0.0], pose.quaternion)})

    timing, stats = timed(run, repeat, warm=lambda: None)
    moved = world.truth()
    assert centre is not None and moved is not None
    travel = float(moved.position[0] - centre.position[0])
    return [
        Measurement(timing, abs(travel - displacement / 2) * 1e3, "mm", "half the sensor's path, by symmetry",
                    "3 mm sideways", stats.substeps, {"travel_mm": travel * 1e3, "residual": stats.residual},
                    "" if stats.settled else "not settled")
    ]  # fmt: skip


ROUGH = {"draft": (2e-3, 3e-3), "standard": (3e-3,)}  # squeezes whose prints are measured [m]


def roughness(preset: str, repeat: int) -> list[Measurement]:
    """Roughness that the sampling of the cube prints on the lower gel (benchmarks/truth/roughness.py)."""
    samplings: tuple[Literal["lattice", "random"], ...] = ("lattice", "random")
    return [_rough_row(preset, sampling, by, repeat) for sampling in samplings for by in ROUGH[preset]]


def _rough_row(preset: str, sampling: Literal["lattice", "random"], by: float, repeat: int) -> Measurement:
    scene = squeeze_scene(preset)
    assert scene.body is not None
    body = scene.body.model_copy(update={"sampling": sampling})
    world = world_in_contact(scene.model_copy(update={"body": body}))
    begin = world.snapshot()

    def run() -> MoveStats:
        world.restore(begin)
        return close_sensors(world, by)

    timing, stats = timed(run, 1, warm=lambda: None)  # seconds are compared in `squeeze`
    error = print_roughness(world.surface("lower"))
    return Measurement(
        timing, error * 1e6, "µm rms", "the print's own local form", f"{sampling}, {by * 1e3:g} mm", stats.substeps, {},
        "" if stats.settled else "not settled",
    )  # fmt: skip


OBLIQUE_DISPLACEMENT = (0.6e-3, 0.0, -0.4e-3)  # of the upper sensor; the lower one moves by its negative [m]
KNEADED = {
    "clay": BodyMaterial(youngs_modulus=0.5e6, poisson_ratio=0.45, yield_stress=20e3),
    "elastic": BodyMaterial(youngs_modulus=0.5e6),
}


def closed_aslant(preset: Preset, repeat: int) -> list[Measurement]:
    """A cube of 6 x 6 x 5 mm, compressed and sheared in one motion from first contact: the force along the gels."""
    rows = []
    for name, material in KNEADED.items():
        timing, (found, stats) = timed(partial(_close_obliquely, preset, material), 1, warm=lambda: None)
        truth, _ = _close_obliquely(preset, material, mach=0.002, tolerance=1e-3, max_substeps=2000)
        figures, note = {"found_n": found, "truth_n": truth}, "" if stats.settled else "not settled"
        error = abs(found / truth - 1) * 100
        rows.append(Measurement(timing, error, "%", "the same mesh at Mach 0.002", name, stats.substeps, figures, note))
    return rows


def _close_obliquely(preset: Preset, material: BodyMaterial, **settling: float) -> tuple[float, MoveStats]:
    body = Body(geometry=Box(size=(6e-3, 6e-3, 5e-3)), material=material)
    friction = {"lower": 0.4, "upper": 0.4}
    world = make_world(Scene(body=body, preset=preset, friction=friction, settling=Settling(**settling)))
    truth = world.truth()
    assert truth is not None
    close_sensors(world, float(world.pose("upper").position[2]) - truth.height)
    displacements = {"upper": np.array(OBLIQUE_DISPLACEMENT), "lower": -np.array(OBLIQUE_DISPLACEMENT)}
    stats = world.move(
        {
            name: Pose(world.pose(name).position + displacement, world.pose(name).quaternion)
            for name, displacement in displacements.items()
        }
    )
    return float(np.hypot(*world.wrench("upper")[:2])), stats


SEED_DRAFT = "particles 0.5 mm, dx 1 mm"
PRESETS = {
    "learn": "particles 1 mm, gel 2 mm",
    "draft": "particles 0.5 mm, gel 1 mm",
    "standard": "particles 0.25 mm, gel 0.5 mm",
}


def _cases(physics: str, method: str) -> tuple[Case, ...]:
    return tuple(
        Case(
            "squeeze",
            run.__name__,
            method,
            PRESETS[preset] if physics == "hybrid" else SEED_DRAFT,
            partial(run, preset, physics),
            baseline,
            # its truth takes minutes the first time
            long=preset == "standard" or (run is settled_squeeze and method == "tacsim"),
        )
        for preset, run, baseline in (
            ("learn", squeeze, False),
            ("learn", settled_squeeze, False),
            ("learn", control_step, False),
            ("learn", reposition, False),
            ("draft", squeeze, method != "tacsim"),
            ("draft", settled_squeeze, method != "tacsim"),
            ("draft", control_step, method != "tacsim"),
            ("draft", reposition, method != "tacsim"),
            ("standard", squeeze, False),
            ("standard", settled_squeeze, False),
            ("standard", reposition, False),
        )
        # the scheme of seed at `standard` takes many minutes, and `learn` is not used for comparisons
        if method == "tacsim" or preset == "draft"
    )


CASES = (
    *_cases("hybrid", "tacsim"),
    *_cases("seed", "seed"),
    *(
        Case("squeeze", "roughness", "tacsim", PRESETS[preset], partial(roughness, preset), long=preset == "standard")
        for preset in ROUGH
    ),
    *(Case("squeeze", "closed_aslant", "tacsim", PRESETS[p], partial(closed_aslant, p)) for p in ("draft", "standard")),
)

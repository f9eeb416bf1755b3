"""Press group: a rigid indenter on one gel, against the limit of fine meshes, closed forms and the FFT layer solver."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.harness.measure import Measurement, Timing, timed
from benchmarks.harness.runner import Case
from benchmarks.truth.layer import LayerContact, layer_contact
from benchmarks.truth.limit import (
    DEPTH,
    ELEMENTS,
    FOLDER,
    GRID_PITCH,
    LIMIT,
    RADIUS,
    Limit,
    extrapolate,
    load_limit,
    rms,
    surface_profile,
)
from tacsim.geometry.shapes import bounding_size
from tacsim.interface import FloatArray, Pose
from tacsim.models.material import GelMaterial
from tacsim.models.scene import Box, Cylinder, Gel, Indenter, Scene, Shape, Sphere
from tacsim.models.tuning import MAX_MACH
from tacsim.physics.move import MoveStats

if TYPE_CHECKING:
    from tacsim.physics.worlds.press import PressWorld


LAYER = "FFT elastic layer"
FORCE_DEPTHS = (0.1e-3, 0.3e-3)
FORCE_RATIOS = (0.45, 0.49)  # Poisson


def press_scene(
    geometry: Shape, element: float, *, nu: float = 0.45, friction: float = 0.6, **settling: float
) -> Scene:  # fmt: skip
    """A gel of 20 x 20 x 4 mm, E = 0.145 MPa, under an indenter with sharp edges, with the controller's defaults except
    for `settling` and a hold without a limit."""
    sharp = 0.0 if isinstance(geometry, Box | Cylinder) else None
    return Scene.model_validate(
        {
            "body": None,
            "indenter": Indenter(geometry=geometry, friction=friction, edge_radius=sharp),
            "gel": Gel(material=GelMaterial(poisson_ratio=nu)),
            "element_size": element,
            "settling": {"max_substeps": 100_000, **settling},
        }
    )


def press(scene: Scene, depth: float) -> tuple[PressWorld, MoveStats]:
    """A new world with the indenter's tip at `depth` [m] below the undeformed gel."""
    from tacsim.physics.worlds.press import PressWorld

    assert scene.indenter is not None
    world = PressWorld(scene)
    pose = world.pose("indenter")
    height = float(bounding_size(scene.indenter.geometry)[2]) / 2 - depth
    stats = world.move({"indenter": Pose(np.array([*pose.position[:2], height]), pose.quaternion)})
    return world, stats


DEFAULT_MACH = MAX_MACH  # the controller's default at nu 0.45, a tenth of the shear wave's speed
# Half of it; more; and a third of the shear wave's speed, at which inertia affects stick and slip.
OTHER_MACHS = (0.015, 0.05, 0.1)


def world_profile(world: PressWorld) -> FloatArray:
    return surface_profile(world.surface("lower"))


def sphere_press(element: float, repeat: int) -> list[Measurement]:
    """Scene to settled surface at the controller's defaults, against the limit of fine meshes."""
    timing, (world, stats) = timed(partial(press, press_scene(Sphere(radius=RADIUS), element), DEPTH), repeat)
    difference = world_profile(world) - load_limit().profile
    return [
        Measurement(
            timing, rms(difference) * 1e6, "µm rms", LIMIT, substeps=stats.substeps,
            figures={"largest_um": _largest(difference), "residual": stats.residual, "overlap_um": stats.overlap * 1e6},
            note="" if stats.settled else "not settled",
        )
    ]  # fmt: skip


def quasi_static(repeat: int) -> list[Measurement]:
    """The same mesh at the default tolerance against a converged one, and at two speeds."""
    ball, element = Sphere(radius=RADIUS), 0.5e-3
    timing, (usual, stats) = timed(partial(press, press_scene(ball, element), DEPTH), repeat)
    reference, _ = press(press_scene(ball, element, mach=0.02, tolerance=1e-5), DEPTH)
    difference = world_profile(usual) - world_profile(reference)
    forces = [abs(float(w.wrench("lower")[2])) for w in (usual, reference)]
    rows = [
        Measurement(
            timing, rms(difference) * 1e6, "µm rms", "same mesh, Mach 0.02, tolerance 1e-5", "tolerance 1e-2",
            stats.substeps, {"largest_um": _largest(difference), "force_percent": percent(*forces)},
        )
    ]  # fmt: skip
    for mach in OTHER_MACHS:
        scene = press_scene(ball, element, mach=mach)
        timing, (other, stats) = timed(partial(press, scene, DEPTH), 1, warm=lambda: None)
        difference = world_profile(other) - world_profile(usual)
        rows.append(
            Measurement(
                timing, _largest(difference), "µm at most", f"the same press at Mach {DEFAULT_MACH:g}, tolerance 1e-2",
                f"two speeds, Mach {DEFAULT_MACH:g} and {mach:g}", stats.substeps, {"rms_um": rms(difference) * 1e6},
                "seconds: at the second speed",
            )
        )  # fmt: skip
    return rows


def sphere_force(element: float, repeat: int) -> list[Measurement]:
    """Force of a shallow frictionless ball against the FFT layer."""
    rows: list[Measurement] = []
    for nu in FORCE_RATIOS:
        scene = press_scene(Sphere(radius=RADIUS), element, nu=nu, friction=0.0, tolerance=1e-3)
        for depth in FORCE_DEPTHS:
            # kernels are warm after the first press
            warm = None if not rows else (lambda: None)
            timing, (world, stats) = timed(partial(press, scene, depth), 1, warm)  # sphere_press compares seconds
            truth = solve_layer(_ball_gap, depth, nu).force
            rows.append(_force_row(timing, world, stats, truth, f"depth {depth * 1e3:g} mm, nu {nu:g}"))
    return rows


def flat_punch(element: float, repeat: int) -> list[Measurement]:
    """Force of a frictionless flat cylinder, radius 3 mm, depth 0.1 mm, against the FFT layer."""
    cylinder, depth, nu = Cylinder(radius=3e-3, height=4e-3), 0.1e-3, 0.45
    scene = press_scene(cylinder, element, nu=nu, friction=0.0, tolerance=1e-3)
    timing, (world, stats) = timed(partial(press, scene, depth), repeat)
    truth = solve_layer(_punch_gap, depth, nu, pixels=768).force
    return [_force_row(timing, world, stats, truth, f"depth {depth * 1e3:g} mm, nu {nu:g}")]


def renew(report_progress: Callable[[str], None]) -> Limit:
    """Computes the limit again and writes it to FOLDER: three meshes, the finest takes many minutes."""
    profiles, forces, substeps = [], [], []
    for element in ELEMENTS:
        report_progress(f"sphere_press: h = {element * 1e3:g} mm")
        world, stats = press(press_scene(Sphere(radius=RADIUS), element, tolerance=1e-4), DEPTH)
        if not stats.settled:
            raise RuntimeError(f"the press at h = {element} m did not settle: residual {stats.residual:.2g}")
        profiles.append(surface_profile(world.surface("lower")))
        forces.append(-float(world.wrench("lower")[2]))
        substeps.append(stats.substeps)
    profile, order = extrapolate(*profiles)
    config = {
        "what": "u_z [m] of the gel's top surface on a grid of 0.25 mm: ball R 4 mm pressed 1 mm into the default gel "
        "(20 x 20 x 4 mm, E 0.145 MPa, nu 0.45), friction 0.6; Richardson limit of the two finest meshes",
        "element_mm": [element * 1e3 for element in ELEMENTS],
        "order": round(order, 3),
        "rms_to_limit_um": [round(rms(p - profile) * 1e6, 3) for p in profiles],
        "force_n": [round(force, 6) for force in forces],
        "substeps": substeps,
    }
    np.save(FOLDER / "sphere_press.npy", profile.astype(np.float32), allow_pickle=False)
    (FOLDER / "sphere_press.json").write_text(json.dumps(config, indent=1) + "\n", encoding="utf-8")
    return Limit(profile, config)


def layer_press(repeat: int) -> list[Measurement]:
    """The independent solver for the deep press: its error results from small strain and no friction."""
    timing, contact = timed(partial(solve_layer, _ball_gap, DEPTH, 0.45), repeat)
    n = contact.displacement.shape[0]
    limit = load_limit()
    step = GRID_PITCH / contact.pixel  # both grids have a point at the centre of the contact
    index = n // 2 + np.rint((np.arange(limit.profile.shape[0]) - limit.profile.shape[0] // 2) * step).astype(int)
    difference = -contact.displacement[np.ix_(index, index)] - limit.profile
    return [
        Measurement(timing, rms(difference) * 1e6, "µm rms", LIMIT, figures={"largest_um": _largest(difference)},
                    note="small strain, frictionless, gel without rim")
    ]  # fmt: skip


def tacchi_press(repeat: int) -> list[Measurement]:
    """The same press at the numbers that Tacchi publishes: particles, sticky contact through the grid, 200 mm/s.
    It has its own kernels, because those of `seed` simulate only two neo-Hookean gels that close on a body, driven by
    their backings; transfers (APIC), update of F and contact through the grid are the same.
    """
    from benchmarks.truth import tacchi  # compiles kernels when it is imported

    return tacchi.sphere_press(repeat)


def solve_layer(
    gap_of_radius: Callable[[FloatArray], FloatArray],
    depth: float,
    nu: float,
    pixels: int = 512,
    thickness: float = 4e-3,
) -> LayerContact:
    """The FFT solver on a periodic square of 32 mm, E = 0.145 MPa; lengths in m."""
    side = 32e-3
    x = (np.arange(pixels) - pixels // 2) * side / pixels
    gap = gap_of_radius(np.hypot(x[:, None], x[None, :]))
    return layer_contact(gap, depth, side / pixels, thickness, 0.145e6, nu)


def _ball_gap(r: FloatArray) -> FloatArray:
    return np.where(r < RADIUS, RADIUS - np.sqrt(np.maximum(RADIUS**2 - r**2, 0.0)), 1.0)


def _punch_gap(r: FloatArray) -> FloatArray:
    return np.where(r < 3e-3, 0.0, 1.0)


def _force_row(timing: Timing, world: PressWorld, stats: MoveStats, truth: float, variant: str) -> Measurement:
    force = abs(float(world.wrench("lower")[2]))
    figures = {"force_n": force, "truth_n": truth}
    return Measurement(timing, percent(force, truth), "%", LAYER, variant, stats.substeps, figures)


def percent(value: float, truth: float) -> float:
    """Error of `value` [%]."""
    return abs(value / truth - 1.0) * 100.0


def _largest(difference: FloatArray) -> float:
    """[µm]"""
    return float(np.abs(difference).max()) * 1e6


CASES = (
    *(Case("press", "sphere_press", "tacsim", f"h {h:g} mm", partial(sphere_press, h * 1e-3)) for h in (1.0, 0.5)),
    Case("press", "sphere_press", "tacsim", "h 0.25 mm", partial(sphere_press, 0.25e-3), long=True),
    Case("press", "sphere_press", "layer", "pixel 0.0625 mm", layer_press),
    Case(
        "press", "sphere_press", "tacchi-settings", "dx 0.129 mm, 214221 particles", tacchi_press, baseline=True
    ),
    Case("press", "quasi_static", "tacsim", "h 0.5 mm", quasi_static),
    Case("press", "sphere_force", "tacsim", "h 0.5 mm", partial(sphere_force, 0.5e-3)),
    Case("press", "sphere_force", "tacsim", "h 0.25 mm", partial(sphere_force, 0.25e-3), long=True),
    Case("press", "flat_punch", "tacsim", "h 0.5 mm", partial(flat_punch, 0.5e-3)),
)  # fmt: skip

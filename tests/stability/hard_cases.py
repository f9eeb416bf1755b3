"""The hard cases, run in a worker process (case_run): each a scene and a list of motions, by name."""

from __future__ import annotations

import math
import struct
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from case_motions import (
    Motions,
    drag,
    escape,
    flow_about,
    impact,
    mark,
    over_the_rim,
    poison,
    push,
    regrasp,
    rest,
    shear,
    squeeze_by,
    squeeze_to,
    then,
    through,
    twist,
)

from tacsim.models.material import BodyMaterial, GelMaterial
from tacsim.models.scene import Body, Box, Cylinder, Gel, Indenter, Mesh, Scene, Settling, Sphere
from tacsim.physics.worlds.tuning import MAX_RETRIES

GEL = Gel(size=(10e-3, 10e-3, 4e-3))
WIDE = Gel(size=(16e-3, 16e-3, 2e-3), material=GelMaterial(youngs_modulus=10e6, poisson_ratio=0.3), housing=None)
CLAY = BodyMaterial(yield_stress=30e3)
QUICK = Settling(mach=0.1, tolerance=1e-2, max_substeps=800)

BOTH, PRESS = ("hybrid", "seed"), ("press",)


@dataclass(frozen=True)
class Case:
    scene: Callable[[str], Scene]
    motions: Motions
    physics: tuple[str, ...] = BOTH
    patch: Mapping[str, Any] = field(default_factory=dict)  # module attribute -> value


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
        sharp = 0.0 if isinstance(made, Box | Cylinder) else None
        indenter = Indenter(geometry=made, edge_radius=sharp)
        return Scene(**{"gel": GEL, "settling": QUICK, **more}, body=None, indenter=indenter)

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


def with_nan(times: int) -> dict[str, Any]:
    return {"fem.copy_arrays": times, "seed.copy_arrays": times}


SHORT = {"hybrid_inertia.BODY_COURANT": 0.3, "press.PRESS_COURANT": 0.3, "seed.COURANT": 0.3}
TOO_LONG = {"hybrid_inertia.BODY_COURANT": 1.2, "press.PRESS_COURANT": 1.2, "seed.COURANT": 1.5}
RUSHED = Settling(mach=0.1, tolerance=1e-2, max_substeps=600, flow_mach=0.15)
USUAL = Settling(tolerance=1e-2, max_substeps=800)
PATIENT = Settling(mach=0.1, tolerance=1e-2)
FOLLOWED = Settling(mach=0.02, tolerance=1e-2, max_substeps=800)
SLOWER = Settling(mach=0.05, tolerance=1e-2, max_substeps=800)
BALL = indented(Sphere(radius=4e-3))
SMALL = cube(3e-3, gel=Gel(size=(8e-3, 8e-3, 4e-3)))
ALWAYS = MAX_RETRIES + 1  # once in every attempt

CASES: dict[str, Case] = {
    # materials at their limits
    "elastic, nu 0.45, to half": Case(cube(material=BodyMaterial(poisson_ratio=0.45), gel=WIDE), squeeze_to(0.5)),
    "elastic, nu 0.49, to half": Case(cube(material=BodyMaterial(poisson_ratio=0.49), gel=WIDE), squeeze_to(0.5)),
    "elastic, nu 0.499, to half": Case(cube(material=BodyMaterial(poisson_ratio=0.499), gel=WIDE), squeeze_to(0.5)),
    "plasticine, k 0.01, to a tenth": Case(
        cube(material=BodyMaterial(yield_strain=0.01), gel=WIDE), squeeze_to(0.1, 8)
    ),
    "plasticine, k 0.05, to a fifth": Case(
        # 21 N; at Mach 0.1 it would end with 37 to 44 N, mostly not at rest
        cube(material=BodyMaterial(yield_strain=0.05), gel=WIDE, settling=FOLLOWED),
        squeeze_to(0.2, 8),
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
    "yield and slide": Case(cube(settling=PATIENT), then(squeeze_by(1.2e-3), drag)),
    "sensor through the body": Case(cube(), through),
    "indenter through the gel": Case(BALL, push(5e-3), PRESS),
    "body over the rim": Case(cube(), over_the_rim),
    "body over the rim, no housing": Case(cube(gel=Gel(size=GEL.size, housing=None)), over_the_rim, ("hybrid",)),
    "release and grasp again": Case(cube(settling=USUAL), regrasp),
    "twist": Case(cube(settling=USUAL), twist),
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

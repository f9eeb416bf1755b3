"""Configuration of a simulated scene: gels, body, indenter, friction, accuracy; and numbers derived from it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self, cast

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from tacsim.interface import Float32, short_repr
from tacsim.models import tuning
from tacsim.models.material import BodyMaterial, GelMaterial, elastic_constants, shear_impedance
from tacsim.models.quantity import Acceleration, Config, Length, Time
from tacsim.models.shape import Box as Box
from tacsim.models.shape import Cylinder as Cylinder
from tacsim.models.shape import Fixture, Oriented, RigidObject, min_side
from tacsim.models.shape import Mesh as Mesh
from tacsim.models.shape import Shape as Shape
from tacsim.models.shape import Sphere as Sphere

Size3 = tuple[Annotated[Length, Field(gt=0)], Annotated[Length, Field(gt=0)], Annotated[Length, Field(gt=0)]]
Along = Annotated[Acceleration, Field(ge=-1e5, le=1e5)]  # one axis [m/s^2]
SensorName = Literal["lower", "upper"]
SIDES = ("left", "right")  # the fingers of a gripper, each with a gel
FixtureName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,63}$")]

Preset = Literal["learn", "draft", "standard"]
# particle spacing and gel element size [m] of each preset
PRESETS: dict[Preset, tuple[float, float]] = {
    "learn": (1.0e-3, 2.0e-3), "draft": (0.5e-3, 1.0e-3), "standard": (0.25e-3, 0.5e-3),
}  # fmt: skip
# Least and greatest error of the normal force of each preset [share], against independent finite elements: a plasticine
# cylinder between two gels, closed by 1, 2 and 3 mm (docs/physics-body.md, the table "closed by").
PRESET_FORCE_ERROR: dict[Preset, tuple[float, float]] = {
    "learn": (0.031, 0.108), "draft": (0.005, 0.041), "standard": (-0.006, 0.021),
}  # fmt: skip


class Gel(Config):
    """One elastic gel pad, bonded to its backing; a rigid housing surrounds it, `housing` below its surface."""

    size: Size3 = (20e-3, 20e-3, 4e-3)  # x, y, thickness [m]
    material: GelMaterial = GelMaterial()
    housing: Annotated[Length, Field(ge=0)] | None = 0.3e-3  # None: no housing


class GelOverride(Config):
    """What one sensor's gel has of its own; what is not given here is as in the scene's `gel`."""

    size: Size3 | None = None  # x, y, thickness [m]
    material: GelMaterial | None = None  # of a material only the keys that are given
    housing: Annotated[Length, Field(ge=0)] | None = None  # given as None: no housing
    element_size: Annotated[Length, Field(gt=0)] | None = None  # overrides the scene's [m]

    def apply_to(self, gel: Gel) -> Gel:
        """`gel` with what is given here in place of its own."""
        change: dict[str, Any] = {}
        if self.size is not None:
            change["size"] = self.size
        if self.material is not None:
            given = {key: getattr(self.material, key) for key in self.material.model_fields_set}
            change["material"] = gel.material.model_copy(update=given)
        if "housing" in self.model_fields_set:
            change["housing"] = self.housing
        return gel.model_copy(update=change)

    @model_serializer(mode="wrap")
    def _serialize_given_only(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """What is not given must not be written: read again, it would count as given."""
        whole = serialize(self)
        if self.material is not None:
            whole["material"] = {key: whole["material"][key] for key in self.material.model_fields_set}
        return {key: value for key, value in whole.items() if key in self.model_fields_set}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, GelOverride) and self.model_dump() == other.model_dump()

    def __hash__(self) -> int:
        return hash(self.model_dump_json())


class Body(Config):
    """The plasticine between the sensors."""

    geometry: Shape = Box()
    material: BodyMaterial = BodyMaterial()
    sampling: Literal["lattice", "random"] = "lattice"  # how particles fill it; random: blue noise, no direction
    seed: Annotated[int, Field(ge=0)] = 0  # of random sampling


class Indenter(Oriented):
    """A rigid body pressed on one gel; no particles are needed for it. Unturned, its own -z side presses."""

    geometry: Shape = Sphere(radius=4e-3)
    # of a box's or cylinder's edges, rounded within its size [m]; None: as the mesh carries them
    # (`effective_edge_radius`); 0: sharp
    edge_radius: Annotated[Length, Field(ge=0)] | None = None
    friction: Annotated[float, Field(ge=0, le=5)] = 0.6

    @model_validator(mode="after")
    def _require_small_edges(self) -> Self:
        geometry, radius = self.geometry, self.edge_radius or 0.0
        if radius > 0 and not isinstance(geometry, Box | Cylinder):
            has = "a sphere has no edges" if isinstance(geometry, Sphere) else "the edges of a mesh are as drawn"
            raise ValueError(f"edge_radius is {radius:g} m, but {has}; leave it out")
        if isinstance(geometry, Box | Cylinder):
            half = min_side(geometry) / 2
            if radius > half:
                raise ValueError(
                    f"edge_radius is {radius:g} m; at most half the shortest side of the {geometry.shape}, {half:g} m"
                )
        return self

    def effective_edge_radius(self, element: float) -> float:
        """Radius of its edges [m] on a mesh of such elements [m]: where none is given the least that does not catch,
        but no more than a quarter of its shortest side; 0 of a ball, and of a mesh, whose edges are as drawn."""
        if not isinstance(self.geometry, Box | Cylinder):
            return 0.0
        if self.edge_radius is not None:
            return self.edge_radius
        return min(tuning.MIN_EDGE_RADIUS * element, min_side(self.geometry) / 4)


class Settling(Config):
    """The quasi-static controller: how exact a state of rest is wanted, and how long it may take."""

    tolerance: Annotated[float, Field(gt=0, le=1)] = 1e-2  # force balance, change of force, and creep to come, relative
    mach: Annotated[float, Field(gt=0, le=0.3)] | None = None  # peak speed / wave speed; None: see Scene.peak_mach
    max_substeps: Annotated[int, Field(ge=0, le=1_000_000)] = 2000  # hold at most this long a move
    flow_mach: Annotated[float, Field(gt=0, le=0.3)] | None = None  # mean speed where motions flow; None: Scene's


class Scene(Config):
    """What is simulated. One of three: a `body` between two gels, a rigid `indenter` on the lower gel alone, or a rigid
    `object` that moves by itself between the fingers of a gripper, in MuJoCo."""

    name: str = "scene"
    physics: Literal["hybrid", "seed"] = "hybrid"
    preset: Preset = "draft"
    particle_spacing: Annotated[Length, Field(gt=0)] | None = None  # overrides the preset
    element_size: Annotated[Length, Field(gt=0)] | None = None  # overrides the preset
    gel: Gel = Gel()  # of every sensor
    gels: dict[SensorName, GelOverride] = {}  # where one differs
    body: Body | None = Body()
    indenter: Indenter | None = None
    object: RigidObject | None = None
    fixtures: dict[FixtureName, Fixture] = Field(default={}, max_length=100)  # what else an object may touch
    timestep: Annotated[Time, Field(ge=1e-4, le=5e-3)] = 1e-3  # of MuJoCo, in a scene with an object [s]
    friction: dict[SensorName, Annotated[float, Field(ge=0, le=5)]] = {"lower": 0.6, "upper": 0.6}
    gravity: tuple[Along, Along, Along] = (0.0, 0.0, 0.0)  # world axes [m/s^2]; acts on body and object
    settling: Settling = Settling()

    @model_validator(mode="after")
    def _require_consistent(self) -> Self:
        given = [name for name in ("body", "indenter", "object") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(
                "give one of body (between two gels), indenter (on one gel) and object (between the fingers of a "
                f"gripper), the others null; here are {' and '.join(given) or 'none of them'}"
            )
        if self.object is not None and self.element_size is not None:
            raise ValueError("element_size: gels that hold an object have the preset's; leave it out, choose a preset")
        if self.fixtures and self.object is None:
            raise ValueError("fixtures: only an object meets them; give the scene an object, or leave them out")
        hardens = self.body is not None and self.body.material.hardening_modulus > 0
        asked = {
            "rigid indenter": self.indenter is not None,
            "rigid object": self.object is not None,
            "hardening": hardens,
            "gravity": any(self.gravity),
        }
        lacking = [what for what, wanted in asked.items() if wanted]
        if self.gels and (self.physics == "seed" or self.body is None):
            which = "physics 'seed' has one gel for both"
            if self.body is None:
                which = "an indenter presses the gel 'lower' alone" if self.indenter else "both pads have the same gel"
            raise ValueError(f"gels: {which}; write what is in gels.{next(iter(self.gels))} into gel, leave out gels")
        if self.physics == "seed" and lacking:
            raise ValueError(f"physics 'seed' has no {lacking[0]}; use physics 'hybrid'")
        if any(self.gravity) and self.indenter is not None:
            raise ValueError("gravity has no body to act on; give the scene a body, or set gravity to [0, 0, 0]")
        missing = [name for name in ("lower", "upper") if self.body is not None and name not in self.friction]
        if missing:
            raise ValueError(f"friction of the surface '{missing[0]}' is missing; give both lower and upper")
        return self

    @model_validator(mode="after")
    def _require_resolution(self) -> Self:
        """Each gel gets at least two layers of elements, and no more cells than a machine has memory for."""
        for name in self.sensors:
            self._require_resolvable(name)
        return self

    def _require_resolvable(self, sensor: str) -> None:
        size, own = self.gel_of(sensor).size, self.gels.get(cast(SensorName, sensor), GelOverride())
        name, edge = (
            ("particle_spacing", self.spacing)
            if self.physics == "seed"
            else ("element_size", self.element_size_of(sensor))
        )
        edge = min(edge, size[2] / 2)  # a thin gel is resolved finer than its preset
        cells, of = math.prod(side / edge for side in size), f" of sensor '{sensor}'" if sensor in self.gels else ""
        if cells > tuning.MAX_ELEMENTS:
            raise ValueError(
                f"a gel{of} of {' x '.join(f'{side:g}' for side in size)} m has {cells:.3g} cells at "
                f"{name} {edge:g} m, the limit is {tuning.MAX_ELEMENTS:,}; choose a larger {name} or a smaller gel"
            )
        given = self.element_size if own.element_size is None else own.element_size
        if given is not None and given > size[2] / 2 * (1 + 1e-9):
            raise ValueError(
                f"element_size {given:g} m is too coarse for a gel{of} {size[2]:g} m thick: it needs "
                f"two layers of elements; choose at most {size[2] / 2:g} m"
            )

    @model_validator(mode="after")
    def _require_settling_speed(self) -> Self:
        """What yields can be followed at the speed that its stress asks for, or a speed is given."""
        allowed = self._mach_by_stress
        if self.settling.mach is None and allowed < tuning.MIN_MACH:
            raise ValueError(
                f"this body yields at so small a stress for its stiffness that it must be moved at Mach {allowed:.2g} "
                f"(default speeds end at {tuning.MIN_MACH:g}), or the speed itself makes it yield; give it a higher "
                f"yield_stress, a lower youngs_modulus or poisson_ratio, or set settling.mach and see what it costs"
            )
        return self

    @property
    def _mach_by_stress(self) -> float:
        """Peak speed at which a motion costs a body no more stress than MACH_BY_STRESS times what it yields at.

        A motion at Mach m costs the stress m M in the body, of P-wave modulus M, since density is scaled so that the
        wave speed is 1; and m sqrt(mu M) in a gel, which gives way with its shear wave. A gel much stiffer than the
        body hardly moves, so what it adds is bounded.
        """
        if self.body is None:
            return math.inf
        mu, lam = elastic_constants(self.body.material)
        body = lam + 2 * mu
        gel = max(shear_impedance(self.gel_of(name).material) for name in self.sensors)
        stress = body + min(tuning.GEL_STRESS_SHARE * gel, tuning.MAX_GEL_STRESS_SHARE * body)
        return tuning.MACH_BY_STRESS * 2 * mu * self.body.material.elastic_limit / stress

    @property
    def sensors(self) -> tuple[str, ...]:
        if self.object is not None:
            return SIDES
        return ("lower", "upper") if self.indenter is None else ("lower",)

    @property
    def peak_mach(self) -> float:
        """Peak speed of a motion between states of rest, over the wave speed; slower on short paths (physics.path).

        A body that yields keeps what the speed wrote into it. So without `settling.mach` the speed goes with the
        tolerance and with the yield stress over the stress that the motion costs (`_mach_by_stress`). What is elastic
        comes to the same rest from any speed, but for friction: it sticks where a stop finds the gel, which follows a
        drag with its shear wave.
        """
        if self.settling.mach is not None:
            return self.settling.mach
        if not math.isfinite(self._mach_by_stress):
            slowest = min(math.sqrt(mu / (lam + 2 * mu)) for mu, lam in self._gel_moduli)
            return min(tuning.MAX_MACH, tuning.MACH_BY_SHEAR * slowest)
        return max(min(1.0, self.settling.tolerance / tuning.DEFAULT_TOLERANCE) * self.max_mach, tuning.MIN_MACH)

    @property
    def _gel_moduli(self) -> list[tuple[float, float]]:
        """Lamé constants of each gel [Pa]."""
        return [elastic_constants(self.gel_of(name).material) for name in self.sensors]

    @property
    def max_mach(self) -> float:
        """The most that this is for a body that yields, at any tolerance."""
        return min(
            self._mach_by_stress, tuning.MAX_MACH * (tuning.LIGHT_SPEED_GAIN if self.physics == "hybrid" else 1.0)
        )

    @property
    def preset_error(self) -> str:
        """The known force error of the preset, as a short text; "unknown" where the scene departs from the preset."""
        changed = self.particle_spacing is not None or self.element_size is not None or self.physics == "seed"
        if changed or self.body is None:
            return "unknown"
        least, greatest = (f"{100 * share:+.0f}" for share in PRESET_FORCE_ERROR[self.preset])
        return f"force {least} to {greatest} %"

    @property
    def flow_mach(self) -> float:
        """Mean speed of motions that flow into one another, over the wave speed; slower on short paths."""
        if self.settling.flow_mach is not None:
            return self.settling.flow_mach
        return tuning.FLOW_MACH if self.body is None else tuning.LIGHT_FLOW_GAIN * tuning.FLOW_MACH

    @property
    def spacing(self) -> float:
        """Particle spacing h_p [m]; the grid spacing is twice as large."""
        return PRESETS[self.preset][0] if self.particle_spacing is None else self.particle_spacing

    @property
    def effective_element_size(self) -> float:
        """Edge of a gel element h_g [m]."""
        return PRESETS[self.preset][1] if self.element_size is None else self.element_size

    def gel_of(self, sensor: str) -> Gel:
        """The gel of a sensor: `gel` with what `gels` gives this sensor of its own."""
        own = self.gels.get(cast(SensorName, sensor))
        return self.gel if own is None else own.apply_to(self.gel)

    def element_size_of(self, sensor: str) -> float:
        """Edge of an element of a sensor's gel [m], before its thickness is divided into whole layers."""
        own = self.gels.get(cast(SensorName, sensor))
        return self.effective_element_size if own is None or own.element_size is None else own.element_size

    def fitted_element_size(self, sensor: str, thickness: float | None = None) -> float:
        """The same as the gel's thickness allows: whole layers, two at least [m]. `thickness` [m]: another one."""
        thickness = self.gel_of(sensor).size[2] if thickness is None else thickness
        return thickness / max(2, round(thickness / self.element_size_of(sensor)))


@dataclass(frozen=True, slots=True, eq=False)
class GelSurface:
    """Displacement of a gel's top surface at the nodes of its own lattice, in the sensor frame.

    Between nodes the surface is the C1 quadratic B-spline with these control values; contact and renderer use the same.
    """

    __repr__ = short_repr

    displacement: Float32  # (nx, ny, 3) [m]; x grows with the first index, y with the second
    spacing: float  # [m]
    origin: tuple[float, float]  # x, y of node (0, 0) at rest, sensor frame [m]

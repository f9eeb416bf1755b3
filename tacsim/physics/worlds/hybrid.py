"""Two gels (FEM in their sensor frames) round a plasticine body (MLS-MPM), coupled by contact with friction memory."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from tacsim.compute.runtime import start
from tacsim.geometry.sampling import body_points
from tacsim.geometry.shapes import extent, volume
from tacsim.interface import Pose, Truth
from tacsim.models.scene import Scene
from tacsim.physics.body.moments import Moments, moments_of
from tacsim.physics.body.plasticine import (
    BORDER,
    BodyParams,
    BodyState,
    body_params,
    bounds_of,
    centre_of,
)
from tacsim.physics.body.surface import surface_points, tangent_planes
from tacsim.physics.contact.contact import ContactHistory
from tacsim.physics.contact.gel_overlap import apart, gel_overlap
from tacsim.physics.exec.lanes import ON_DEVICE, PARTS
from tacsim.physics.exec.layout import (
    BACKING,
    BODY_DAMPING,
    BODY_MASS,
    CARRIED,
    CENTRE,
    COUNTS,
    ELEMENTS,
    FILTERED,
    FORCE,
    FRICTION,
    GEL_DAMPING,
    GEL_DENSITY,
    GRAVITY,
    GREEN,
    HOUSING,
    HOUSING_FORCE,
    INVERSE_INERTIA,
    NUMBERS,
    OWN,
    PARAMS,
    REFERENCE_CENTRE,
    RIGID_MASS_SCALE,
    STEP,
    STIFFNESS,
    WIDENING,
)  # fmt: skip
from tacsim.physics.exec.team import run_team
from tacsim.physics.failure.diagnosis import volume_range
from tacsim.physics.failure.health import NO_ROOM, Health, SimulationDiverged, check_launch, require_room
from tacsim.physics.gel.gel import GelState, common_lattice, gel_params
from tacsim.physics.motion.controller import ForceReading, Integration, Launch, PreparedLaunch, force_floor
from tacsim.physics.motion.inertia import Inertia, kernel_density, kernel_second
from tacsim.physics.units import MM, MPA
from tacsim.physics.worlds.fem import FemState, FemWorld, stack_drives
from tacsim.physics.worlds.hybrid_kernels import substeps
from tacsim.pose import HALF_TURN_X

if TYPE_CHECKING:
    from tacsim.physics.worlds.device_state import DeviceHybrid

# dt / (smallest spacing / wave speed). At 0.8 the contact of body and gel fails, without a NaN.
COURANT = 0.5
# Damping of a driven motion falsifies its path, since gels yield and the body spreads; damping of the hold does not.
ZETA_GEL, ZETA_GEL_HELD = 0.8, 1.6  # zeta in rate = zeta c / thickness
ZETA_BODY, ZETA_BODY_HELD = 0.4, 0.8  # zeta in rate = zeta c / gel thickness, against the driven affine motion
# How nodes answer to forces: by their own acceleration, and by that filtered by (4 S - 1)^2, S the mean over the cells
# round them. What the mesh resolves, S = 1, is six times as light; the shortest waves, S = 0, are as heavy as they are.
TRUE_INERTIA = {OWN: 1.0, FILTERED: 0.0}
SELECTIVE_INERTIA = {OWN: 1 / 3, FILTERED: 2 / 3}
FILTERED_RIGID = SELECTIVE_INERTIA[OWN] + 9.0 * SELECTIVE_INERTIA[FILTERED] - 1.0  # lighter by this are rigid motions
LARGEST_SHARE = 0.5  # of a particle's mass over the step's square: the largest stiffness of its contact
GEL_OVERLAP = 0.25  # of a gel's thickness: deeper in one another, gels that do not feel each other are refused
# Yield stresses (Frobenius norm) of hydrostatic tension that nothing gives a squeezed body: beyond, particles have
# strains that no node of the grid feels (docs/physics.md)
TENSION = 3.0
LARGEST_GREEN = 0.3  # norm of F^T F - I since the reference of the body's grid: beyond, the grid is laid anew
CLEARANCE = 0.1e-3  # gap between gels and body at construction [m]


class HybridState(FemState):
    """Arrays of E environments that one launch of `substeps` advances; each environment is a HybridWorld.

    Environments share the gels' lattice; each has its own body, materials, friction and settling.
    """

    device: DeviceHybrid | None = None

    def __init__(self, scenes: Sequence[Scene]) -> None:
        """Raises ValueError for gels that are not cut alike."""
        start()
        self.gel = [gel_params(scene.gel, scene.element) for scene in scenes]
        self._gels = GelState(common_lattice(self.gel), len(scenes), 2)
        placed = [_body_at_start(scene) for scene in scenes]
        self.body = [body for body, _, _ in placed]
        self._particles = BodyState([points for _, points, _ in placed], [planes for _, _, planes in placed])
        # of the contact law [mm]
        self._contact_history = np.zeros((len(scenes), 2, max(self._particles.counts), ContactHistory.n), np.float32)
        self.params = np.zeros((len(scenes), PARAMS), np.float32)
        self.counts = np.zeros((len(scenes), COUNTS), np.int32)
        self.counts[:, ELEMENTS : ELEMENTS + 3] = self.gel[0].elements
        self.partial = np.zeros((len(scenes), PARTS, NUMBERS), np.float32)
        if ON_DEVICE:
            from tacsim.physics.worlds.device_state import DeviceHybrid

            numbers = self.params, self.counts, self.partial
            self.device = DeviceHybrid(self._gels, numbers, self._particles, lambda: self._contact_history)

    @property
    def particles(self) -> BodyState:
        self._bring_back()
        return self._particles

    @property
    def contact_history(self) -> np.ndarray:
        self._bring_back()
        return self._contact_history

    def extents(self, index: int) -> np.ndarray:
        """See `BodyState.extents`; what follows is likewise of one environment, wherever its arrays are."""
        return self._particles.extents(index) if self.device is None else self.device.survey(index).extents

    def fit(self, index: int, cell: float, extents: np.ndarray) -> None:
        """Lays its grid. Raises MemoryError."""
        # a node at its border has no mass: the cells round each that has are all there (tacsim.physics.body.mass)
        self._particles.fit(index, cell, 2.0 * cell, self.params, self.counts, extents)

    def moments(self, index: int) -> Moments:
        return moments_of(self._particles, index) if self.device is None else self.device.moments(index)

    def centre(self, index: int) -> np.ndarray:
        """Of the particles (3,) [mm]."""
        return centre_of(self._particles.x(index)) if self.device is None else self.device.moments(index).centre

    def outside(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions [mm] and tangent planes [1/mm] of the particles, (n, 3) both."""
        if self.device is not None:
            return self.device.outside(index)
        return self._particles.x(index), self._particles.plane(index)

    @property
    def most_nodes(self) -> int:
        """Of a grid, see `BodyState.most`."""
        return self._particles.most

    def place(self, index: int, scene: Scene) -> None:
        """One environment as it is at the construction of another scene. Raises ValueError for gels cut otherwise."""
        gel = gel_params(scene.gel, scene.element)
        common_lattice([*self.gel, gel])
        body, points, planes = _body_at_start(scene)
        self.gel[index], self.body[index] = gel, body
        self.gels.u[index], self.gels.v[index] = 0.0, 0.0
        self.particles.place(index, points, planes)
        missing = max(self.particles.counts) - self.contact_history.shape[2]
        if missing > 0:
            self._contact_history = np.pad(self.contact_history, ((0, 0), (0, 0), (0, missing), (0, 0)))
        self.contact_history[index], self.params[index], self.partial[index] = 0.0, 0.0, 0.0
        self.counts[index] = 0
        self.counts[index, ELEMENTS : ELEMENTS + 3] = gel.elements

    def advance(self, drives: Mapping[int, np.ndarray]) -> None:
        drive = stack_drives(drives, self.counts)
        if self.device is not None:
            self.device.run(drive)
            return
        self._gels.refresh()
        run_team(
            substeps, drive, self._gels.arguments(), self._particles.arguments(),
            self._particles.changes.reshape(-1), self._contact_history, self.params,
            self.counts, self.partial, active=list(drives),
        )  # fmt: skip


@lru_cache(maxsize=256)
def _inverse_of(second: bytes) -> np.ndarray:
    """Pseudo-inverse of second moments (3, 3) float64: those of a reference stay for many launches."""
    inverse: np.ndarray = np.linalg.pinv(np.frombuffer(second).reshape(3, 3), rcond=1e-6, hermitian=True)
    return inverse


def _body_at_start(scene: Scene) -> tuple[BodyParams, np.ndarray, np.ndarray]:
    """A scene's body: parameters, particles at construction (n, 3) [mm], their tangent planes (n, 3) [1/mm]."""
    assert scene.body is not None
    height = float(extent(scene.body.geometry)[2])
    points = body_points(scene.body, scene.spacing)
    body = body_params(scene.body.material, scene.spacing, volume=volume(scene.body.geometry) / len(points))
    planes = tangent_planes(scene.body.geometry, points, scene.spacing) / MM
    return body, (points + [0.0, 0.0, height / 2 + CLEARANCE]) * MM, planes


class HybridWorld(FemWorld):
    """World of a scene with a body: `lower` and `upper` gel, and the plasticine between them."""

    sensors = ("lower", "upper")
    balanced = True

    def __init__(self, scene: Scene, state: HybridState | None = None, index: int = 0) -> None:
        """The environment of scene number `index` in a `state` of several; or one alone in a state of its own."""
        assert scene.body is not None
        self.scene = scene
        self._state: HybridState = HybridState([scene]) if state is None else state
        self._index = index
        self._gel, self._body = self._state.gel[index], self._state.body[index]
        self.yields = math.isfinite(scene.body.material.elastic_limit)
        height = float(extent(scene.body.geometry)[2])
        self._poses = {
            "lower": Pose(),
            "upper": Pose(np.array([0.0, 0.0, height + 2 * CLEARANCE]), HALF_TURN_X.quaternion),
        }
        self._rates = np.zeros((2, 6))
        self._floor = force_floor(scene.gel.material.youngs_modulus * MPA, self._gel.thickness)
        self._mach = scene.peak_mach
        housing = scene.gel.housing
        # Inertia is scaled, weight is not: rho g [1e-9 N/mm^3] over the kernel's density, the P-wave modulus [MPa].
        self._body_force = scene.body.material.density * np.array(scene.gravity) * MPA / MM  # [N/mm^3]
        self._weight = self._body_force * self._body.volume * self._state.particles.counts[index]  # [N]
        params = {
            **self._gel.params(), **self._body.params(),
            FRICTION: scene.friction["lower"], FRICTION + 1: scene.friction["upper"],
            HOUSING: -1.0 if housing is None else housing * MM,
        }  # fmt: skip
        self._state.params[index, list(params)] = list(params.values())
        self._scaled, self._true = self._scaled_inertia(height * MM), self._true_inertia()
        self._use_inertia(self._scaled)

    # ---------------------------------------------------------------- inertia

    def _scaled_inertia(self, height: float) -> Inertia:
        """Of quasi-static motions; height: of the body [mm]."""
        step = COURANT * min(self._body.cell, self._gel.spacing)
        damping = {
            GEL_DAMPING: ZETA_GEL / self._gel.thickness, BODY_DAMPING: ZETA_BODY / self._gel.thickness,
            # The body's slowest mode is its rigid translation between two soft gels: there it counts as lighter by
            # the number of particle layers. Two contact layers of stiffness ~ m_p / dt^2 then stay below
            # the step limit.
            RIGID_MASS_SCALE: max(1.0, height / self._body.spacing - FILTERED_RIGID),
        }  # fmt: skip
        held = {
            GEL_DAMPING: ZETA_GEL_HELD / self._gel.thickness, BODY_DAMPING: ZETA_BODY_HELD / self._gel.thickness,
        }  # fmt: skip
        masses = {**self._masses(self._gel.density, self._body.density, step), **SELECTIVE_INERTIA}
        # the filter makes a body lighter, so its particles bear less: between stiff gels they shook, untold
        masses[STIFFNESS] = min(masses[STIFFNESS], LARGEST_SHARE * masses[BODY_MASS] / step**2)
        return Inertia({**masses, **damping, WIDENING: 0.0}, step, held=held, flowing={WIDENING: 1.0})

    def _true_inertia(self) -> Inertia:
        assert self.scene.body is not None
        second = kernel_second(self._gel, self.scene.gel.material.density)
        density = kernel_density(self.scene.body.material.density, second)
        wave = math.sqrt(self._body.density / density)  # the body's pressure wave; the gel's has speed 1
        step = COURANT * min(self._body.cell / wave, self._gel.spacing)
        undamped = {GEL_DAMPING: 0.0, BODY_DAMPING: 0.0, RIGID_MASS_SCALE: 1.0, WIDENING: 0.0}
        return Inertia({**self._masses(self._gel.density, density, step), **TRUE_INERTIA, **undamped}, step, second)

    def _masses(self, gel: float, body: float, step: float) -> dict[int, float]:
        """Entries of `params` that follow from the densities [MPa] and the substep [mm]."""
        particle = body * self._body.volume
        # penalty of one particle against its share of a gel node: stable whichever of the two is lighter
        share = gel * self._gel.spacing * self._body.spacing**2 / 2
        reduced = 1.0 / (1.0 / particle + 1.0 / share)
        gravity = self._body_force / body  # [1/mm]
        return {
            GEL_DENSITY: gel, BODY_MASS: particle, STIFFNESS: reduced / step**2,
            GRAVITY: gravity[0], GRAVITY + 1: gravity[1], GRAVITY + 2: gravity[2],
        }  # fmt: skip

    def _stop(self) -> None:
        b, i = self._state.particles, self._index
        for moving in (self._state.gels.v[i], b.v(i), b.c(i)):
            moving[...] = 0.0

    def _courant(self) -> float:
        """Of gels and body: the larger; the body's grid does not shrink with it."""
        params = self._state.params[self._index]
        wave = math.sqrt(self._body.particle_mass / params[BODY_MASS])  # the speed of the body's pressure wave
        return max(super()._courant(), float(params[STEP]) * wave / self._body.cell)

    # ------------------------------------------------------------------ state

    def arrays(self) -> dict[str, np.ndarray]:
        state, i = self._state, self._index
        b = state.particles
        return {
            "gel_displacement": state.gels.u[i], "gel_velocity": state.gels.v[i],
            "position": b.x(i), "velocity": b.v(i), "affine": b.c(i), "strain": b.e(i), "flow": b.plastic_strain(i),
            "reference": b.reference(i), "gradient": b.gradient(i), "planes": b.plane(i),
            "contact": state.contact_history[i, :, : b.counts[i]], "sums": state.partial[i],
        }  # fmt: skip

    def truth(self) -> Truth:
        x, planes = self._state.outside(self._index)
        height = float(np.ptp(surface_points(x, planes)[:, 2])) / MM
        return Truth(height, x.mean(axis=0, dtype=np.float64) / MM, (x / MM).astype(np.float32), dict(self._poses))

    # ----------------------------------------------------------------- motion

    def prepare(self, launch: Launch) -> PreparedLaunch:
        """Fits the grid and sets this environment's parameters. Raises SimulationDiverged for a grid too large."""
        state, index, path = self._state, self._index, launch.path
        drive = path.drive(launch.first, launch.last)
        span = path.span(self._poses, launch.first, launch.last)
        cell = self._body.cell
        if state.partial[index, :, GREEN].max() > LARGEST_GREEN**2:
            state.particles.move_reference(index)
        extents = state.extents(index)
        low, high = bounds_of(extents)
        require_room(low - BORDER * cell, high + BORDER * cell, cell, span, state.most_nodes)
        try:
            state.fit(index, cell, extents)
        except MemoryError as error:
            raise SimulationDiverged(f"no memory for the grid round the particles ({error})", span, NO_ROOM) from None
        before = self._before_launch()
        state.params[index, STEP] = path.step
        self._write_body_inertia(state.moments(index))
        self._write_inertia(launch)
        Health.clear(state.partial[index])
        return PreparedLaunch(launch, drive, span, before)

    def _write_body_inertia(self, moments: Moments) -> None:
        """Centre, inverse moment of inertia and mean motion of the particles since their reference, for the kernels."""
        params = self._state.params[self._index]
        params[REFERENCE_CENTRE : REFERENCE_CENTRE + 3] = moments.reference_centre
        params[CARRIED : CARRIED + 9] = (moments.moved @ _inverse_of(moments.reference_second.tobytes())).ravel()
        second = moments.second * float(params[BODY_MASS])
        inertia = np.trace(second) * np.eye(3) - second
        inverse = _pseudo_inverse(inertia)
        params[CENTRE : CENTRE + 3] = moments.centre
        params[INVERSE_INERTIA : INVERSE_INERTIA + 6] = inverse[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]

    def outcome(self, prepared: PreparedLaunch) -> ForceReading:
        """The forces after the launch. Raises SimulationDiverged if its state is unphysical."""
        partial = self._state.partial[self._index]
        seen = self._survey()
        health = Health.read(partial, self._courant(), sound=seen is not None and seen.sound)
        check_launch(self.arrays, prepared.before, health, prepared.span)
        rotations, origins = prepared.drive[-1, :, :3], prepared.drive[-1, :, 3]
        sums = partial.astype(np.float64)
        force, moment = sums[:, FORCE : FORCE + 12].sum(axis=0).reshape(2, 2, 3).swapaxes(0, 1)
        backing = sums[:, BACKING : BACKING + 3].reshape(2, -1, 3).sum(axis=1)  # which holds the housing too
        backing += sums[:, HOUSING_FORCE : HOUSING_FORCE + 6].sum(axis=0).reshape(2, 3)
        contact = np.einsum("gij,gj->gi", rotations, force)
        backing = np.einsum("gij,gj->gi", rotations, backing)
        centre = self._state.centre(self._index)
        torque = (np.einsum("gij,gj->gi", rotations, moment) + np.cross(origins - centre, contact)).sum(axis=0)
        lever = max(self._gel.half)
        gel_overlap = self._gel_overlap(prepared)
        volumes = volume_range(self.arrays()) if seen is None else seen.volumes
        hits = health.capped + (gel_overlap > 0.0) + self._torn(volumes[1])
        return ForceReading(
            contact, backing, self._floor, health.overlap, hits,
            moment / lever, self._weight, torque / lever,
            Integration(prepared.launch.path.step, self._damping(), health.courant), gel_overlap, volumes,
        )  # fmt: skip

    def _torn(self, largest: float) -> bool:
        """Whether the largest elastic volume ratio needs a tension of more than TENSION yield stresses; of a body that
        hardens nobody knows."""
        body = self._body
        bearable = TENSION * 2.0 * body.mu * body.limit / body.bulk
        return self.yields and not body.hardening and math.log(largest) > bearable

    def _gel_overlap(self, prepared: PreparedLaunch) -> float:
        """How deep the two gels lie in one another, without feeling it [mm]. Raises SimulationDiverged if too deep."""
        last = prepared.drive[-1].astype(np.float64)
        seen = self._survey()
        if seen is not None and apart(self._gel, seen.tops[1], float(seen.tops[0, 3]), last[:, :3], last[:, 3]):
            return 0.0
        found = gel_overlap(self._gel, self._state.tops(self._index), last[:, :3], last[:, 3])
        most = GEL_OVERLAP * self._gel.thickness
        if found > most:
            raise SimulationDiverged(
                f"the gels lie {found:.3g} mm inside one another, which they do not feel (limit {most:.3g} mm)",
                prepared.span, "keep the sensors further apart, or use physics 'seed'", retry=False,
                good=prepared.before, failed=self.arrays(),
            )  # fmt: skip
        return found


def _pseudo_inverse(inertia: np.ndarray) -> np.ndarray:
    """Of a moment of inertia (3, 3). Particles on a line have none about it, and do not turn about it."""
    moments, axes = np.linalg.eigh(inertia)
    moments, axes = moments[::-1], np.ascontiguousarray(axes[:, ::-1])
    inverse = np.divide(1.0, moments, out=np.zeros(3), where=moments > 1e-6 * moments[0])
    turns: np.ndarray = axes @ (inverse[:, None] * axes.T)
    return turns

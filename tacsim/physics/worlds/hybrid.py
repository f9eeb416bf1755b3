"""Two gels (FEM in their sensor frames) and a plasticine body (MLS-MPM), coupled by contact with friction memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from tacsim.geometry.shapes import bounding_size
from tacsim.interface import Pose, Truth
from tacsim.models.scene import Scene
from tacsim.physics.body.moments import Moments
from tacsim.physics.body.plasticine import bounds_of_parts, bounds_of_points, grid_around
from tacsim.physics.body.surface import surface_points
from tacsim.physics.body.tuning import GRID_BORDER, STENCIL_REACH
from tacsim.physics.contact.gel_overlap import are_separated, gel_overlap
from tacsim.physics.exec.lanes import NODES
from tacsim.physics.exec.layout import (
    BACKING,
    BODY_MASS,
    CENTRE,
    FORCE,
    FRICTION,
    HOUSING,
    HOUSING_FORCE,
    INVERSE_INERTIA,
    MEAN_GRADIENT,
    OVERLAP,
    RECORD_INTERVAL,
    RECORDS,
    REFERENCE_CENTRE,
    RIGID_MASS_SCALE,
    SQUARED_GREEN_STRAIN,
    STEP,
    STIFFNESS,
    STIFFNESS_RATIO,
)  # fmt: skip
from tacsim.physics.failure.diagnosis import volume_range
from tacsim.physics.failure.health import MEMORY_ADVICE, Health, SimulationDiverged, check_launch, require_grid_memory
from tacsim.physics.failure.tuning import MAX_SPEED
from tacsim.physics.gel.tuning import MIN_VOLUME_RATIO
from tacsim.physics.motion.controller import (
    ForceReading,
    Integration,
    Launch,
    Motion,
    PreparedLaunch,
    force_floor,
)
from tacsim.physics.motion.inertia import Inertia
from tacsim.physics.motion.path import PEAK_BRAKING, Path, path_length, plan_path, tangential_path_length
from tacsim.physics.motion.tuning import SHORT_PATH, SHORT_SLIDE
from tacsim.physics.move import MIN_LAYERS, MoveCommand, MoveStats, warn_of_few_layers
from tacsim.physics.snapshot import State
from tacsim.physics.units import MM, MPA
from tacsim.physics.worlds.fem import FemWorld
from tacsim.physics.worlds.hybrid_inertia import FILTERED_RIGID, LIGHTER_GEL, HybridInertia
from tacsim.physics.worlds.hybrid_state import HybridState
from tacsim.physics.worlds.tuning import (
    INITIAL_GAP,
    MAX_BRAKING_FORCE,
    MAX_DRAG_OVERSPEED,
    MAX_FORCE_LOSS,
    MAX_GEL_OVERLAP,
    MAX_GREEN_STRAIN,
    MAX_TENSION,
    MAX_YIELDING_OVERSPEED,
    MIN_DRAG_SHARE,
    MIN_TENSION_GROWTH,
)
from tacsim.pose import HALF_TURN_X


class HybridWorld(FemWorld):
    """World of a scene with a body: `lower` and `upper` gel, and the plasticine between them."""

    sensors = ("lower", "upper")
    balanced = True
    _relative_height = 1.0  # height of the body over that at construction, from the spread of its particles along z
    _largest_volume = 1.0  # elastic volume ratio of a particle after the last launch; 1 after a restore

    def __init__(self, scene: Scene, state: HybridState | None = None, index: int = 0) -> None:
        """The environment of scene number `index` in a `state` of several; without `state`, a single environment."""
        assert scene.body is not None
        self.scene = scene
        self.state: HybridState = HybridState([scene]) if state is None else state
        self._index = index
        self._gels, self._body = self.state.gel[index], self.state.body[index]
        self.yields = math.isfinite(scene.body.material.elastic_limit)
        self.max_force_loss = MAX_FORCE_LOSS * self._body.spacing / max(gel.thickness for gel in self._gels)
        height = float(bounding_size(scene.body.geometry)[2])
        self._poses = {
            "lower": Pose(),
            "upper": Pose(np.array([0.0, 0.0, height + 2 * INITIAL_GAP]), HALF_TURN_X.quaternion),
        }
        self._rates = np.zeros((2, 6))
        gels = [scene.gel_of(name) for name in self.sensors]
        self._floor = min(  # of the softer, thinner gel
            force_floor(gel.material.youngs_modulus * MPA, params.thickness)
            for gel, params in zip(gels, self._gels, strict=True)
        )
        # Inertia is scaled, weight is not: rho g [1e-9 N/mm^3] over the kernel's density, the P-wave modulus [MPa].
        self._body_force = scene.body.material.density * np.array(scene.gravity) * MPA / MM  # [N/mm^3]
        self._weight = self._body_force * self._body.volume * self.state.particle_counts[index]  # [N]
        params = self._body.params()
        for g, (name, gel) in enumerate(zip(self.sensors, gels, strict=True)):
            params |= self._gels[g].params(g)
            params[FRICTION + g] = scene.friction[name]  # type: ignore[index]
            params[HOUSING + g] = -1.0 if gel.housing is None else gel.housing * MM
        self.state.params[index, list(params)] = list(params.values())
        self._inertias = HybridInertia(scene, self._gels, self._body, self._body_force)
        self._scaled, self._true = (
            self._inertias.scaled_inertia(height * MM, yields=self.yields),
            self._inertias.true_inertia(),
        )
        self._use_inertia(self._scaled)

    # ---------------------------------------------------------------- inertia

    def _stop(self) -> None:
        b, i = self.state.particles, self._index
        self.state.gels.clear(i, velocity_only=True)
        for moving in (b.v(i), b.c(i)):
            moving[...] = 0.0
        b.drop_grid_velocities(i)

    def _run_command(self, command: MoveCommand) -> Motion:
        if command.duration is not None:
            self._require_friction()
        return (yield from super()._run_command(command))

    def _require_friction(self) -> None:
        """Raises ValueError for a motion in real time of a body between two gels without friction."""
        touches = all(self.wrench(name)[2] < 0.0 for name in self.sensors)
        if touches and not any(self.scene.friction.values()):
            raise ValueError(
                "friction.lower and friction.upper are 0: a body that gels squeeze without friction is in an unstable "
                "equilibrium, and in real time it leaves them within a second. Give one of them a friction above 0 "
                "(0.02 holds it), or move without a duration"
            )

    def _switch_inertia(self, inertia: Inertia) -> None:
        """See FemWorld. Contacts keep their forces: the next launch starts with the present stiffness of springs."""
        params = self.state.params[self._index]
        gels = len(self._gels)
        springs, stiffness = params[STIFFNESS_RATIO : STIFFNESS_RATIO + gels], params[STIFFNESS : STIFFNESS + gels]
        before = springs * stiffness
        super()._switch_inertia(inertia)
        springs[...] = before / stiffness

    def _use_inertia(self, inertia: Inertia) -> None:
        super()._use_inertia(inertia)
        self._reset_springs()

    def _reset_springs(self) -> None:
        """The next launch starts with contact forces from its own stiffness."""
        self.state.params[self._index, STIFFNESS_RATIO : STIFFNESS_RATIO + len(self._gels)] = 1.0

    def _courant(self) -> float:
        """The larger of the gels' and the body's; the body's grid is not compressed with the body."""
        params = self.state.params[self._index]
        wave = math.sqrt(self._body.particle_mass / params[BODY_MASS])  # the speed of the body's pressure wave
        return max(super()._courant(), float(params[STEP]) * wave / self._body.cell)

    # ----------------------------------------------------------------- motion

    def plan(self, start: Sequence[Pose], end: Sequence[Pose]) -> Path:
        """The path between two poses of the sensors, at the scene's speed. The memory length is the whole path for a
        body that yields, otherwise the part along the surface (friction)."""
        scene, lever, self.unsettled_reason = self.scene, self._lever, ""
        memory_length = (path_length if self.yields else tangential_path_length)(start, end, lever)
        along = tangential_path_length(start, end, lever)
        drag = self._drag_time(along)
        path = plan_path(
            start, end, scene.peak_mach, self._scaled.step, lever, self._thickness, memory_length=memory_length,
            short_length=SHORT_PATH if self.yields else SHORT_SLIDE,
            min_time=drag if scene.settling.mach is None else 0.0,
        )  # fmt: skip
        path = replace(path, is_drag=along > MIN_DRAG_SHARE * path_length(start, end, lever))
        if self.yields and path.peak_mach(lever) > MAX_YIELDING_OVERSPEED * scene.max_mach:
            self.unsettled_reason = "the speed of the motion makes the body yield; leave out settling.mach, or lower it"
        elif drag > MAX_DRAG_OVERSPEED * path.substeps * path.dt:
            self.unsettled_reason = "the body slips by its inertia at that speed; leave out settling.mach, or lower it"
        return replace(
            path, is_creeping=self.yields, max_force_loss=self.max_force_loss, unsettled_reason=self.unsettled_reason
        )

    def _drag_time(self, along: float) -> float:
        """Smallest duration [mm, wave speed 1] of a path of length `along` the gels [mm] that ends with the full
        friction of a body that slips. During deceleration the body's inertia reduces the friction, and the body sticks.

        0 without a body between the gels, or without friction."""
        held = [max(0.0, -float(self.wrench(name)[2])) for name in self.sensors]
        frictions = self.scene.friction["lower"], self.scene.friction["upper"]
        limits = [friction * force for friction, force in zip(frictions, held, strict=True) if friction > 0.0]
        if not limits or min(held) == 0.0:
            return 0.0
        params, count = self._scaled.params, self.state.particle_counts[self._index]
        body = params[BODY_MASS] * count / (params[RIGID_MASS_SCALE] + FILTERED_RIGID)
        max_gel_mass = max(gel.density * gel.thickness for gel in self._gels)
        layer = max_gel_mass * (self._body.volume * count) ** (2 / 3) / (2.0 * LIGHTER_GEL)
        return math.sqrt(PEAK_BRAKING * along * (body + layer) / (MAX_BRAKING_FORCE * min(limits)))

    # ------------------------------------------------------------------ state

    def arrays(self) -> dict[str, np.ndarray]:
        state, i = self.state, self._index
        b = state.particles
        return {
            **state.gels.arrays(i),
            "position": b.x(i), "velocity": b.v(i), "affine": b.c(i), "strain": b.e(i), "flow": b.plastic_strain(i),
            "reference": b.reference(i), "gradient": b.gradient(i), "planes": b.plane(i),
            "contact": state.contact_history[i, :, : b.counts[i]], "sums": state.partial[i],
        }  # fmt: skip

    def _stored_grid_shape(self) -> tuple[int, int, int]:
        return self.state.stored_grid_shape(self._index)

    def _grid(self, shape: tuple[int, int, int]) -> dict[str, np.ndarray]:
        return {"grid_velocity": self.state.particles.grid_velocity(self._index, shape)}

    def _allocate_grid(self, state: State) -> dict[str, np.ndarray]:
        own = self.state.particles.reference(self._index)
        places = np.asarray(state.get("reference", own))
        if places.shape != own.shape or not np.can_cast(places.dtype, own.dtype, "same_kind"):
            places = own  # the state will be refused
        if np.size(state.get("grid_velocity", ())) == 0 or not np.isfinite(places).all():
            return {}
        _, (nx, ny, nz) = grid_around(
            *bounds_of_points(places.astype(np.float32)), self._body.cell, STENCIL_REACH * self._body.cell
        )
        return {"grid_velocity": np.empty((nx, ny, nz - NODES + 1, 3), np.float32)}

    def _restore_grid(self, grid: State) -> None:
        state, i = self.state, self._index
        self._largest_volume = 1.0
        if not grid:
            state.particles.drop_grid_velocities(i)
            return
        state.fit_grid(i, self._body.cell, state.extents(i))
        state.particles.set_grid_velocities(i, state.counts, grid["grid_velocity"])

    def truth(self) -> Truth:
        x, planes = self.state.positions_and_planes(self._index)
        height = float(np.ptp(surface_points(x, planes)[:, 2])) / MM
        return Truth(height, x.mean(axis=0, dtype=np.float64) / MM, (x / MM).astype(np.float32), dict(self._poses))

    # ----------------------------------------------------------------- motion

    def prepare(self, launch: Launch) -> PreparedLaunch:
        """Fits the grid and sets this environment's parameters. Raises SimulationDiverged for a grid too large."""
        state, index, path = self.state, self._index, launch.path
        drive, where = path.drive(launch.first, launch.last), partial(launch.span, tuple(self._poses))
        cell = self._body.cell
        if state.partial[index, :, SQUARED_GREEN_STRAIN].max() > MAX_GREEN_STRAIN**2:
            state.particles.move_reference(index)
        extents = state.extents(index)
        low, high = bounds_of_parts(extents)
        require_grid_memory(low - GRID_BORDER * cell, high + GRID_BORDER * cell, cell, where, state.max_nodes)
        try:
            state.fit_grid(index, cell, extents)
        except MemoryError as error:
            cause = f"no memory for the grid around the particles ({error})"
            raise SimulationDiverged(cause, where(), MEMORY_ADVICE) from None
        before = self._before_launch()
        state.params[index, STEP] = path.step
        state.counts[index, RECORD_INTERVAL] = -(-len(drive) // launch.readings)
        moments = state.moments(index)
        self._relative_height = math.sqrt(moments.second[2, 2] / state.particle_counts[index]) / state.heights[index]
        self._write_body_inertia(moments)
        self._write_inertia(launch)
        Health.clear(state.partial[index])
        return PreparedLaunch(launch, where, drive, before)

    def _write_body_inertia(self, moments: Moments) -> None:
        """Writes centre, inverse moment of inertia and mean displacement gradient of the particles for the kernels."""
        params = self.state.params[self._index]
        params[REFERENCE_CENTRE : REFERENCE_CENTRE + 3] = moments.reference_centre
        params[MEAN_GRADIENT : MEAN_GRADIENT + 9] = moments.mean_displacement_gradient().ravel()
        inverse = moments.inverse_inertia(float(params[BODY_MASS]))
        params[CENTRE : CENTRE + 3] = moments.centre
        params[INVERSE_INERTIA : INVERSE_INERTIA + 6] = inverse[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]

    def _complete_stats(self, stats: MoveStats) -> MoveStats:
        assert self.scene.body is not None
        layers = self._relative_height * float(bounding_size(self.scene.body.geometry)[2]) / self.scene.spacing
        few = layers < MIN_LAYERS
        if few:
            warn_of_few_layers()
        return replace(stats, particle_layers=layers, few_layers=few)

    def outcome(self, prepared: PreparedLaunch) -> list[ForceReading]:
        """The forces in and after the launch. Raises SimulationDiverged if its state is unphysical."""
        partial = self.state.partial[self._index]
        survey = self._survey()
        volumes = volume_range(self.state.particles.e(self._index)) if survey is None else survey.volumes
        is_healthy = self._is_healthy(volumes[0]) if survey is None else survey.is_healthy
        health = Health.read(partial, self._courant(), is_healthy=is_healthy)
        check_launch(self.arrays, prepared.before, health, prepared.where)
        self._reset_springs()
        each, drive = self._numbers(prepared.launch.readings), prepared.drive[-1]
        rotations, origins = drive[:, :3], drive[:, 3]  # sensors do not move where there are several readings
        sums = each.astype(np.float64)
        forces, moments = np.moveaxis(sums[..., FORCE : FORCE + 12].sum(axis=1).reshape(-1, 2, 2, 3), 2, 0)
        backings = sums[..., BACKING : BACKING + 3].reshape(len(each), 2, -1, 3).sum(axis=2)  # includes the housing:
        backings += sums[..., HOUSING_FORCE : HOUSING_FORCE + 6].sum(axis=1).reshape(-1, 2, 3)
        contacts, backings, turns = (np.einsum("gij,ngj->ngi", rotations, of) for of in (forces, backings, moments))
        torques = (turns + _cross(origins - self.state.centre(self._index), contacts)).sum(axis=1)
        lever = self._lever
        gel_overlap = self._gel_overlap(prepared)
        hits = health.capped + (gel_overlap > 0.0) + self._exceeds_tension(volumes[1])
        self._largest_volume = volumes[1]
        overlaps = each[..., OVERLAP].max(axis=1).tolist()
        integration = Integration(prepared.launch.path.step, self._damping(), health.courant)
        last = len(each) - 1
        return [
            ForceReading(
                contacts[n], backings[n], self._floor, overlaps[n], hits if n == last else 0, moments[n] / lever,
                self._weight, torques[n] / lever, integration, gel_overlap, volumes,
            )
            for n in range(len(each))
        ]  # fmt: skip

    def _numbers(self, readings: int) -> np.ndarray:
        """(readings, PARTS, NUMBERS) of the parts; the last are those of the launch's end."""
        state, i = self.state, self._index
        if readings == 1:
            return state.partial[i : i + 1]
        return np.concatenate([state.records[i, : readings - 1], state.partial[i : i + 1]])

    @property
    def _readings(self) -> int:
        return 1 + RECORDS

    def _is_healthy(self, smallest_volume: float) -> bool:
        """See `Health.is_healthy`. It tests whole arrays, which is fast; `diagnosis` finds the fault and its place."""
        state, i = self.state, self._index
        others = state.particles.particle_rows(i), state.contact_history[i], state.partial[i]
        return (
            smallest_volume > 2.0 * MIN_VOLUME_RATIO
            and state.gels.is_slow_and_finite(i, MAX_SPEED)
            and all(np.isfinite(a).all() for a in others)
        )

    def _exceeds_tension(self, largest: float) -> bool:
        """Whether the largest elastic volume ratio has increased in the launch to that of a tension above MAX_TENSION.
        False for a body that hardens, for which that is not known, and without an increase in this launch.
        """
        body = self._body
        limit = MAX_TENSION * 2.0 * body.mu * body.limit / body.bulk
        left = MIN_TENSION_GROWTH * math.log(self._largest_volume)
        return self.yields and not body.hardening and math.log(largest) > max(limit, left)

    def _gel_overlap(self, prepared: PreparedLaunch) -> float:
        """Overlap of the two gels, between which there is no contact [mm]. Raises SimulationDiverged above the
        limit."""
        last = prepared.drive[-1].astype(np.float64)
        survey = self._survey()
        if survey is not None and are_separated(
            self._gels, survey.surface_bounds[1], float(survey.surface_bounds[0, 3]), last[:, :3], last[:, 3]
        ):
            return 0.0
        found = gel_overlap(self._gels, self.state.surface_displacements(self._index), last[:, :3], last[:, 3])
        max_overlap = MAX_GEL_OVERLAP * min(gel.thickness for gel in self._gels)
        if found > max_overlap:
            raise SimulationDiverged(
                f"the gels overlap by {found:.3g} mm; there is no contact between gels (limit {max_overlap:.3g} mm)",
                prepared.where(), "keep the sensors further apart, or use physics 'seed'", retry=False,
                good=prepared.before, failed=self.arrays(),
            )  # fmt: skip
        return found


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products of vectors (..., 3); for two vectors three times faster than np.cross."""
    return np.stack([a[..., i] * b[..., j] - a[..., j] * b[..., i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=-1)

"""Two gels (FEM in their sensor frames) round a plasticine body (MLS-MPM), coupled by contact with friction memory."""

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
from tacsim.physics.body.plasticine import bounds, bounds_of, fit_grid
from tacsim.physics.body.surface import surface_points
from tacsim.physics.body.tuning import GRID_BORDER, STENCIL_REACH
from tacsim.physics.contact.gel_overlap import apart, gel_overlap
from tacsim.physics.exec.lanes import NODES
from tacsim.physics.exec.layout import (
    BACKING,
    BODY_MASS,
    CARRIED,
    CENTRE,
    EVERY,
    FORCE,
    FRICTION,
    GREEN,
    HOUSING,
    HOUSING_FORCE,
    INVERSE_INERTIA,
    OVERLAP,
    RECORDS,
    REFERENCE_CENTRE,
    RIGID_MASS_SCALE,
    SPRINGS,
    STEP,
    STIFFNESS,
)  # fmt: skip
from tacsim.physics.failure.diagnosis import volume_range
from tacsim.physics.failure.health import NO_ROOM, Health, SimulationDiverged, check_launch, require_room
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
from tacsim.physics.motion.path import PEAK_BRAKING, Path, path_along, path_length, plan
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
    _squashed = 1.0  # height of the body over that at construction, by the spread of its particles along z
    _largest_volume = 1.0  # elastic volume ratio of a particle after the last launch; 1: none since a restore

    def __init__(self, scene: Scene, state: HybridState | None = None, index: int = 0) -> None:
        """The environment of scene number `index` in a `state` of several; or one alone in a state of its own."""
        assert scene.body is not None
        self.scene = scene
        self._state: HybridState = HybridState([scene]) if state is None else state
        self._index = index
        self._gels, self._body = self._state.gel[index], self._state.body[index]
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
        self._weight = self._body_force * self._body.volume * self._state.particle_counts[index]  # [N]
        params = self._body.params()
        for g, (name, gel) in enumerate(zip(self.sensors, gels, strict=True)):
            params |= self._gels[g].params(g)
            params[FRICTION + g] = scene.friction[name]  # type: ignore[index]
            params[HOUSING + g] = -1.0 if gel.housing is None else gel.housing * MM
        self._state.params[index, list(params)] = list(params.values())
        self._inertias = HybridInertia(scene, self._gels, self._body, self._body_force)
        self._scaled, self._true = self._inertias.scaled(height * MM, yields=self.yields), self._inertias.true()
        self._use_inertia(self._scaled)

    # ---------------------------------------------------------------- inertia

    def _stop(self) -> None:
        b, i = self._state.particles, self._index
        self._state.gels.clear(i, velocity_only=True)
        for moving in (b.v(i), b.c(i)):
            moving[...] = 0.0
        b.forget_grid(i)

    def _run_command(self, command: MoveCommand) -> Motion:
        if command.duration is not None:
            self._require_friction()
        return (yield from super()._run_command(command))

    def _require_friction(self) -> None:
        """Raises ValueError for a motion in real time of a body that two gels hold without friction."""
        touches = all(self.wrench(name)[2] < 0.0 for name in self.sensors)
        if touches and not any(self.scene.friction.values()):
            raise ValueError(
                "friction.lower and friction.upper are 0: a body that gels squeeze without friction is in an unstable "
                "balance, and in real time it leaves them within a second. Give one of them a friction above 0 (0.02 "
                "holds it), or move without a duration"
            )

    def _switch_inertia(self, inertia: Inertia) -> None:
        """See FemWorld. Contacts keep their forces: the next launch starts from springs of the stiffness before."""
        params = self._state.params[self._index]
        gels = len(self._gels)
        springs, stiffness = params[SPRINGS : SPRINGS + gels], params[STIFFNESS : STIFFNESS + gels]
        before = springs * stiffness
        super()._switch_inertia(inertia)
        springs[...] = before / stiffness

    def _use_inertia(self, inertia: Inertia) -> None:
        super()._use_inertia(inertia)
        self._forget_springs()

    def _forget_springs(self) -> None:
        """The next launch starts from the forces that its own stiffness gives."""
        self._state.params[self._index, SPRINGS : SPRINGS + len(self._gels)] = 1.0

    def _courant(self) -> float:
        """Of gels and body: the larger; the body's grid does not shrink with it."""
        params = self._state.params[self._index]
        wave = math.sqrt(self._body.particle_mass / params[BODY_MASS])  # the speed of the body's pressure wave
        return max(super()._courant(), float(params[STEP]) * wave / self._body.cell)

    # ----------------------------------------------------------------- motion

    def plan(self, start: Sequence[Pose], end: Sequence[Pose]) -> Path:
        """The path between two poses of the sensors, at the scene's speed: all of it is remembered by a body that
        yields, by friction alone what goes along a surface."""
        scene, lever, self.unfollowed = self.scene, self._lever, ""
        remembered = (path_length if self.yields else path_along)(start, end, lever)
        along = path_along(start, end, lever)
        drag = self._drag_time(along)
        path = plan(
            start, end, scene.peak_mach, self._scaled.step, lever, self._thickness, remembered=remembered,
            short=SHORT_PATH if self.yields else SHORT_SLIDE, shortest=drag if scene.settling.mach is None else 0.0,
        )  # fmt: skip
        path = replace(path, dragging=along > MIN_DRAG_SHARE * path_length(start, end, lever))
        if self.yields and path.peak_mach(lever) > MAX_YIELDING_OVERSPEED * scene.max_mach:
            self.unfollowed = "the speed itself makes the body yield; leave out settling.mach, or lower it"
        elif drag > MAX_DRAG_OVERSPEED * path.substeps * path.dt:
            self.unfollowed = "the body slips by its inertia at that speed; leave out settling.mach, or lower it"
        return replace(path, creeps=self.yields, max_force_loss=self.max_force_loss, unfollowed=self.unfollowed)

    def _drag_time(self, along: float) -> float:
        """Least time [mm, wave speed 1] of a path that goes `along` the gels [mm] and ends with all friction of a body
        that slips. While that is braked, its inertia takes some of the friction away, and there it sticks.

        0 where nothing is held between the gels, or no friction holds it."""
        held = [max(0.0, -float(self.wrench(name)[2])) for name in self.sensors]
        frictions = self.scene.friction["lower"], self.scene.friction["upper"]
        limits = [friction * force for friction, force in zip(frictions, held, strict=True) if friction > 0.0]
        if not limits or min(held) == 0.0:
            return 0.0
        params, count = self._scaled.params, self._state.particle_counts[self._index]
        body = params[BODY_MASS] * count / (params[RIGID_MASS_SCALE] + FILTERED_RIGID)
        heaviest = max(gel.density * gel.thickness for gel in self._gels)
        layer = heaviest * (self._body.volume * count) ** (2 / 3) / (2.0 * LIGHTER_GEL)
        return math.sqrt(PEAK_BRAKING * along * (body + layer) / (MAX_BRAKING_FORCE * min(limits)))

    # ------------------------------------------------------------------ state

    def arrays(self) -> dict[str, np.ndarray]:
        state, i = self._state, self._index
        b = state.particles
        return {
            **state.gels.arrays(i),
            "position": b.x(i), "velocity": b.v(i), "affine": b.c(i), "strain": b.e(i), "flow": b.plastic_strain(i),
            "reference": b.reference(i), "gradient": b.gradient(i), "planes": b.plane(i),
            "contact": state.contact_history[i, :, : b.counts[i]], "sums": state.partial[i],
        }  # fmt: skip

    def _grid_kept(self) -> tuple[int, int, int]:
        return self._state.grid_kept(self._index)

    def _grid(self, shape: tuple[int, int, int]) -> dict[str, np.ndarray]:
        return {"grid_velocity": self._state.particles.grid_velocity(self._index, shape)}

    def _lay(self, state: State) -> dict[str, np.ndarray]:
        own = self._state.particles.reference(self._index)
        places = np.asarray(state.get("reference", own))
        if places.shape != own.shape or not np.can_cast(places.dtype, own.dtype, "same_kind"):
            places = own  # of a state that will be refused
        if np.size(state.get("grid_velocity", ())) == 0 or not np.isfinite(places).all():
            return {}
        _, (nx, ny, nz) = fit_grid(*bounds(places.astype(np.float32)), self._body.cell, STENCIL_REACH * self._body.cell)
        return {"grid_velocity": np.empty((nx, ny, nz - NODES + 1, 3), np.float32)}

    def _take_up(self, grid: State) -> None:
        state, i = self._state, self._index
        self._largest_volume = 1.0
        if not grid:
            state.particles.forget_grid(i)
            return
        state.fit(i, self._body.cell, state.extents(i))
        state.particles.keep_grid(i, state.counts, grid["grid_velocity"])

    def truth(self) -> Truth:
        x, planes = self._state.outside(self._index)
        height = float(np.ptp(surface_points(x, planes)[:, 2])) / MM
        return Truth(height, x.mean(axis=0, dtype=np.float64) / MM, (x / MM).astype(np.float32), dict(self._poses))

    # ----------------------------------------------------------------- motion

    def prepare(self, launch: Launch) -> PreparedLaunch:
        """Fits the grid and sets this environment's parameters. Raises SimulationDiverged for a grid too large."""
        state, index, path = self._state, self._index, launch.path
        drive, where = path.drive(launch.first, launch.last), partial(launch.span, tuple(self._poses))
        cell = self._body.cell
        if state.partial[index, :, GREEN].max() > MAX_GREEN_STRAIN**2:
            state.particles.move_reference(index)
        extents = state.extents(index)
        low, high = bounds_of(extents)
        require_room(low - GRID_BORDER * cell, high + GRID_BORDER * cell, cell, where, state.most_nodes)
        try:
            state.fit(index, cell, extents)
        except MemoryError as error:
            cause = f"no memory for the grid round the particles ({error})"
            raise SimulationDiverged(cause, where(), NO_ROOM) from None
        before = self._before_launch()
        state.params[index, STEP] = path.step
        state.counts[index, EVERY] = -(-len(drive) // launch.readings)
        moments = state.moments(index)
        self._squashed = math.sqrt(moments.second[2, 2] / state.particle_counts[index]) / state.heights[index]
        self._write_body_inertia(moments)
        self._write_inertia(launch)
        Health.clear(state.partial[index])
        return PreparedLaunch(launch, where, drive, before)

    def _write_body_inertia(self, moments: Moments) -> None:
        """Centre, inverse moment of inertia and mean motion of the particles since their reference, for the kernels."""
        params = self._state.params[self._index]
        params[REFERENCE_CENTRE : REFERENCE_CENTRE + 3] = moments.reference_centre
        params[CARRIED : CARRIED + 9] = moments.carried().ravel()
        inverse = moments.inverse_inertia(float(params[BODY_MASS]))
        params[CENTRE : CENTRE + 3] = moments.centre
        params[INVERSE_INERTIA : INVERSE_INERTIA + 6] = inverse[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]

    def _judged(self, stats: MoveStats) -> MoveStats:
        assert self.scene.body is not None
        layers = self._squashed * float(bounding_size(self.scene.body.geometry)[2]) / self.scene.spacing
        few = layers < MIN_LAYERS
        if few:
            warn_of_few_layers()
        return replace(stats, particle_layers=layers, few_layers=few)

    def outcome(self, prepared: PreparedLaunch) -> list[ForceReading]:
        """The forces in and after the launch. Raises SimulationDiverged if its state is unphysical."""
        partial = self._state.partial[self._index]
        seen = self._survey()
        volumes = volume_range(self._state.particles.e(self._index)) if seen is None else seen.volumes
        sound = self._sound(volumes[0]) if seen is None else seen.sound
        health = Health.read(partial, self._courant(), sound=sound)
        check_launch(self.arrays, prepared.before, health, prepared.where)
        self._forget_springs()
        each, drive = self._numbers(prepared.launch.readings), prepared.drive[-1]
        rotations, origins = drive[:, :3], drive[:, 3]  # sensors stand still where there are several readings
        sums = each.astype(np.float64)
        forces, moments = np.moveaxis(sums[..., FORCE : FORCE + 12].sum(axis=1).reshape(-1, 2, 2, 3), 2, 0)
        backings = sums[..., BACKING : BACKING + 3].reshape(len(each), 2, -1, 3).sum(axis=2)  # of the housing too:
        backings += sums[..., HOUSING_FORCE : HOUSING_FORCE + 6].sum(axis=1).reshape(-1, 2, 3)
        contacts, backings, turns = (np.einsum("gij,ngj->ngi", rotations, of) for of in (forces, backings, moments))
        torques = (turns + _cross(origins - self._state.centre(self._index), contacts)).sum(axis=1)
        lever = self._lever
        gel_overlap = self._gel_overlap(prepared)
        hits = health.capped + (gel_overlap > 0.0) + self._torn(volumes[1])
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
        """(readings, PARTS, NUMBERS) of the parts, those of the launch's end last."""
        state, i = self._state, self._index
        if readings == 1:
            return state.partial[i : i + 1]
        return np.concatenate([state.records[i, : readings - 1], state.partial[i : i + 1]])

    @property
    def _readings(self) -> int:
        return 1 + RECORDS

    def _sound(self, smallest_volume: float) -> bool:
        """See Health.sound. Of whole arrays, since there are many small ones; what is wrong where, others find out."""
        state, i = self._state, self._index
        others = state.particles.whole(i), state.contact_history[i], state.partial[i]
        return (
            smallest_volume > 2.0 * MIN_VOLUME_RATIO
            and state.gels.quiet(i, MAX_SPEED)
            and all(np.isfinite(a).all() for a in others)
        )

    def _torn(self, largest: float) -> bool:
        """Whether the largest elastic volume ratio has grown in the launch to one that needs a tension of more than
        MAX_TENSION; unknown for a body that hardens. What an earlier launch has left is not counted again.
        """
        body = self._body
        bearable = MAX_TENSION * 2.0 * body.mu * body.limit / body.bulk
        left = MIN_TENSION_GROWTH * math.log(self._largest_volume)
        return self.yields and not body.hardening and math.log(largest) > max(bearable, left)

    def _gel_overlap(self, prepared: PreparedLaunch) -> float:
        """How deep the two gels lie in one another, without feeling it [mm]. Raises SimulationDiverged if too deep."""
        last = prepared.drive[-1].astype(np.float64)
        seen = self._survey()
        if seen is not None and apart(self._gels, seen.tops[1], float(seen.tops[0, 3]), last[:, :3], last[:, 3]):
            return 0.0
        found = gel_overlap(self._gels, self._state.tops(self._index), last[:, :3], last[:, 3])
        most = MAX_GEL_OVERLAP * min(gel.thickness for gel in self._gels)
        if found > most:
            raise SimulationDiverged(
                f"the gels lie {found:.3g} mm inside one another, which they do not feel (limit {most:.3g} mm)",
                prepared.where(), "keep the sensors further apart, or use physics 'seed'", retry=False,
                good=prepared.before, failed=self.arrays(),
            )  # fmt: skip
        return found


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products of vectors (..., 3); np.cross takes three times as long for two."""
    return np.stack([a[..., i] * b[..., j] - a[..., j] * b[..., i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=-1)

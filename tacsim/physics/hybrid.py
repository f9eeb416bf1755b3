"""Two gels (FEM in their sensor frames) round a plasticine body (MLS-MPM), coupled by contact with friction memory."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from tacsim.interface import Pose, Truth
from tacsim.physics.body_surface import surface_points, tangent_planes
from tacsim.physics.contact import contact_ceiling, particle_contact, support_radius
from tacsim.physics.controller import (
    Launch,
    Motion,
    Path,
    Prepared,
    Reading,
    force_floor,
    merged,
    move_and_settle,
    plan,
    run,
)
from tacsim.physics.gel import (
    MM,
    MPA,
    Corners,
    GelState,
    Lattice,
    NodeLanes,
    Nodes,
    Skin,
    Touch,
    clear_touch,
    gel_advance,
    gel_facts,
    gel_forces,
    gel_surface,
    one_lattice,
)
from tacsim.physics.health import Health, copies, judged, require_room, retried
from tacsim.physics.lanes import LANES, PARTS, SLOTS, Counts, Facts, Partial, Work, first_of, vec3, vec4
from tacsim.physics.layout import (
    BACKING,
    BODY_CELL,
    BODY_DAMPING,
    BODY_MASS,
    CAPACITY,
    COUNTS,
    FACTS,
    FORCE,
    FRICTION,
    GEL_DAMPING,
    GRAVITY,
    GRID,
    HOUSED,
    HOUSING,
    LIGHTNESS,
    MOTION,
    NUMBERS,
    ORIGIN,
    OVERLAP,
    PARTICLES,
    STEP,
    STEPS,
    STIFFNESS,
    STRIDE,
)  # fmt: skip
from tacsim.physics.load import keep_loads, require_loads
from tacsim.physics.plasticine import (
    BodyFacts,
    BodyState,
    Masses,
    Points,
    Rates,
    Strains,
    Sums,
    Velocities,
    body_facts,
    clear_masses,
    grid_to_particles,
    node_sum,
    particles_to_grid,
)
from tacsim.physics.team import CHUNK, WHO, Sync, first_in_chunk, meet, run_team, shares
from tacsim.physics.world import MoveStats, put_back, taken
from tacsim.pose import HALF_TURN_X
from tacsim.runtime import start, ti
from tacsim.sampling import body_points
from tacsim.scene import GelSurface, Scene
from tacsim.shapes import extent, volume

COURANT = 0.4  # dt / (smallest spacing / wave speed)
ZETA_GEL = 1.0  # zeta in alpha = zeta c / thickness
ZETA_BODY = 0.4  # zeta in rate = zeta c / gel thickness, against the driven affine motion
CLEARANCE = 0.1e-3  # gap between gels and body at construction [m]

Drive = ti.types.ndarray(dtype=ti.f32, ndim=5)
ContactMemory = ti.types.ndarray(dtype=vec4, ndim=3)


@ti.func
def row(drive: ti.template(), env, it, g, r):
    return vec3(drive[env, it, g, r, 0], drive[env, it, g, r, 1], drive[env, it, g, r, 2])


@ti.func
def rotation(drive: ti.template(), env, it, g):
    return ti.Matrix.rows([row(drive, env, it, g, 0), row(drive, env, it, g, 1), row(drive, env, it, g, 2)])


@ti.func
def part_sum(partial: ti.template(), env, first):
    """Sum of three numbers over all parts, in their order."""
    total = vec3(0.0)
    for part in ti.static(range(PARTS)):
        total += vec3(partial[env, part, first], partial[env, part, first + 1], partial[env, part, first + 2])
    return total


@ti.func
def grid_update(
    env, part, it, drive: ti.template(), masses: ti.template(), velocities: ti.template(), facts: ti.template(),
    counts: ti.template(), partial: ti.template(),
):  # fmt: skip
    """Momentum to velocity; damps towards the affine motion that the two sensors impose, not towards rest.

    A boost is added to every velocity: selective mass scaling of the slowest mode, the rigid translation of a body that
    hangs between two soft gels. Inertia is artificial here anyway; the resting state does not depend on it.

    Across the sensors' axis the reference is the body's own mean velocity while anything is driven: a body that rides
    on one sensor must not be dragged back by the other.
    """
    dt, cell, damping = facts[env, STEP], facts[env, BODY_CELL], facts[env, BODY_DAMPING]
    origin = vec3(facts[env, ORIGIN], facts[env, ORIGIN + 1], facts[env, ORIGIN + 2])
    weight = vec3(facts[env, GRAVITY], facts[env, GRAVITY + 1], facts[env, GRAVITY + 2])
    push = facts[env, BODY_MASS] * counts[env, PARTICLES] * weight  # total force on the body: weight and contact
    for g in ti.static(range(2)):
        push -= rotation(drive, env, it, g) @ part_sum(partial, env, FORCE + 6 * g)
    mean = part_sum(partial, env, MOTION) / counts[env, PARTICLES]
    boost = ((facts[env, LIGHTNESS] - 1.0) * dt / (facts[env, BODY_MASS] * counts[env, PARTICLES])) * push
    p0, p1 = row(drive, env, it, 0, 3), row(drive, env, it, 1, 3)
    v0, v1 = row(drive, env, it, 0, 4), row(drive, env, it, 1, 4)
    w0, w1 = row(drive, env, it, 0, 5), row(drive, env, it, 1, 5)
    axis = p1 - p0
    length2 = axis.norm_sqr() + 1e-12
    driven = v0.norm_sqr() + v1.norm_sqr() + w0.norm_sqr() + w1.norm_sqr() > 0.0
    mean_across = mean - axis * (mean.dot(axis) / length2)
    nx, ny, nz = counts[env, GRID], counts[env, GRID + 1], counts[env, GRID + 2]
    base = env * counts[env, CAPACITY]
    for i in range(first_of(nx, part, PARTS), first_of(nx, part + 1, PARTS)):
        for j in range(ny):
            for k in range(nz):
                node = (i * ny + j) * nz + k
                q = node_sum(env, i, node, masses, counts)
                velocity = vec3(0.0)
                if q[3] != 0.0:  # a mass that is not a number must show
                    velocity = vec3(q[0], q[1], q[2]) / q[3] + boost + dt * weight
                    x = origin + cell * vec3(i, j, k)
                    t = ti.max(0.0, ti.min(1.0, (x - p0).dot(axis) / length2))
                    reference = (1.0 - t) * (v0 + w0.cross(x - p0)) + t * (v1 + w1.cross(x - p1))
                    if driven:
                        reference = axis * (reference.dot(axis) / length2) + mean_across
                    velocity -= damping * dt * (velocity - reference)
                velocities[base + node] = vec4(velocity[0], velocity[1], velocity[2], 0.0)


@ti.func
def touch_gel(
    env, part, g, it, drive: ti.template(), points: ti.template(), planes: ti.template(), rates: ti.template(),
    memory: ti.template(), skin: ti.template(), touch: ti.template(), facts: ti.template(), counts: ti.template(),
    partial: ti.template(), layers, nx, ny,
):  # fmt: skip
    """Contact of this part's particles with gel g. Notes force and moment of the body on the sensor, sensor axes."""
    rotate = rotation(drive, env, it, g)
    origin, velocity, spin = row(drive, env, it, g, 3), row(drive, env, it, g, 4), row(drive, env, it, g, 5)
    back = rotate.transpose()
    outward = vec3(rotate[0, 2], rotate[1, 2], rotate[2, 2])  # the sensor's z axis
    highest, spacing = contact_ceiling(skin, env, g), 0.5 * facts[env, BODY_CELL]
    rate = facts[env, STEP] / facts[env, BODY_MASS]
    total, moment, on_housing = vec3(0.0), vec3(0.0), vec3(0.0)
    n, origin_p = counts[env, PARTICLES], env * counts[env, STRIDE]
    for p in range(first_of(n, part, PARTS), first_of(n, part + 1, PARTS)):
        at = points[origin_p + p]
        arm = vec3(at[0], at[1], at[2]) - origin
        radius = support_radius(planes[origin_p + p], spacing)
        # one radius to touch, half a spacing for what the contact's memory still bridges
        if outward.dot(arm) < highest + radius + 0.5 * spacing:  # most of the body is far away: one dot product decides
            local = back @ arm
            moving = rates[origin_p + p, 0]
            relative = back @ (vec3(moving[0], moving[1], moving[2]) - velocity - spin.cross(arm))
            touching, housed, force, kept = particle_contact(
                env, part, g, local, relative, memory[env, g, p], radius, skin, touch, facts, layers, nx, ny, partial
            )
            memory[env, g, p] = kept
            if touching:
                push = rate * (rotate @ force)
                rates[origin_p + p, 0] = moving + vec4(push[0], push[1], push[2], 0.0)
                total -= force
                moment -= local.cross(force)
                if housed:
                    on_housing -= force
        else:
            memory[env, g, p] = vec4(0.0)
    for d in ti.static(range(3)):
        partial[env, part, FORCE + 6 * g + d] = total[d]
        partial[env, part, FORCE + 6 * g + 3 + d] = moment[d]
        partial[env, part, HOUSED + 3 * g + d] = on_housing[d]


@ti.kernel
def substeps(
    team: ti.i32, drive: Drive,
    nodes: Nodes, n0: NodeLanes, nj: NodeLanes, ni: NodeLanes, nij: NodeLanes, skin: Skin, touch: Touch,
    c0: Corners, cj: Corners, ci: Corners, cij: Corners, lattice: Lattice,
    points: Points, planes: Points, rates: Rates, strains: Strains, masses: Masses, velocities: Velocities,
    sums: Sums, memory: ContactMemory,
    facts: Facts, counts: Counts, work: Work, partial: Partial, sync: Sync,
):  # fmt: skip
    """Explicit substeps of every environment's scene in one launch, `team` threads an environment.

    Two meetings a substep: what is scattered must be whole before it is summed, and summed before it is gathered.
    """
    for task in range(sync.shape[0] * team * CHUNK):
        for _ in range(first_in_chunk(task)):
            turn, member = task // CHUNK // team, task // CHUNK % team
            env = sync[turn, WHO]
            layers, nx, ny = nodes.shape[4] - 1, skin.shape[3] - 3, skin.shape[4] - 3
            for it in range(counts[env, STEPS]):
                for share in range(shares(member, team)):
                    part = member + share * team
                    partial[env, part, OVERLAP] = 0.0
                    clear_touch(env, part, 2, touch)
                    for g in range(2):
                        touch_gel(
                            env, part, g, it, drive, points, planes, rates, memory, skin, touch, facts, counts, partial,
                            layers, nx, ny,
                        )  # fmt: skip
                    clear_masses(env, part, masses, counts)
                    particles_to_grid(env, part, points, rates, strains, masses, facts, counts, partial)
                    gel_forces(
                        env, part, 2, n0, nj, ni, nij, c0, cj, ci, cij, lattice, facts, counts, work, partial,
                        layers, nx, ny,
                    )  # fmt: skip
                meet(sync, turn, team, 2 * it + 1)
                for share in range(shares(member, team)):
                    part = member + share * team
                    gel_advance(env, part, 2, nodes, n0, skin, touch, lattice, facts, counts, partial, layers, nx, ny)
                    grid_update(env, part, it, drive, masses, velocities, facts, counts, partial)
                meet(sync, turn, team, 2 * it + 2)
                for share in range(shares(member, team)):
                    part = member + share * team
                    grid_to_particles(
                        env, part, points, planes, rates, strains, velocities, sums, facts, counts, partial
                    )


class HybridState:
    """Arrays of E environments that one launch of `substeps` advances; each environment is a HybridWorld.

    Environments share the gels' lattice; bodies, materials, friction and settling are each one's own.
    """

    def __init__(self, scenes: Sequence[Scene]) -> None:
        """Raises ValueError for gels that are not cut alike."""
        start()
        self.gel = [gel_facts(scene.gel, scene.element) for scene in scenes]
        self.gels = GelState(one_lattice(self.gel), len(scenes), 2)
        placed = [_placed(scene) for scene in scenes]
        self.body = [body for body, _, _ in placed]
        self.particles = BodyState([points for _, points, _ in placed], [planes for _, _, planes in placed])
        # of the contact law [mm]
        self.memory = np.zeros((len(scenes), 2, self.particles.points.shape[1], 4), np.float32)
        self.facts = np.zeros((len(scenes), FACTS), np.float32)
        self.counts = np.zeros((len(scenes), COUNTS), np.int32)
        self.partial = np.zeros((len(scenes), PARTS, NUMBERS), np.float32)
        self._work = np.zeros((len(scenes) * PARTS * SLOTS, LANES), np.float32)

    def advance(self, drives: Mapping[int, np.ndarray]) -> None:
        """One launch; drives: (n, 2, 6, 3) of the environments that go on, n each one's own."""
        drive = side_by_side(drives, self.counts)
        self.gels.refresh()
        run_team(
            substeps, drive, self.gels.arguments(), self.particles.arguments(), self.memory, self.facts, self.counts,
            self._work, self.partial, active=list(drives),
        )  # fmt: skip


def _placed(scene: Scene) -> tuple[BodyFacts, np.ndarray, np.ndarray]:
    """A scene's body: facts; particles at construction (n, 3) [mm]; their tangent planes (n, 3) [1/mm]."""
    assert scene.body is not None
    height = float(extent(scene.body.geometry)[2])
    points = body_points(scene.body, scene.spacing)
    body = body_facts(scene.body.material, scene.spacing, volume=volume(scene.body.geometry) / len(points))
    planes = tangent_planes(scene.body.geometry, points, scene.spacing) / MM
    return body, (points + [0.0, 0.0, height / 2 + CLEARANCE]) * MM, planes


def side_by_side(drives: Mapping[int, np.ndarray], counts: np.ndarray) -> np.ndarray:
    """Drives (n, frames, 6, 3) of some environments in one array (E, longest, ...); writes all n into `counts`."""
    counts[:, STEPS] = 0
    first = next(iter(drives.values()))
    longest = max(len(drive) for drive in drives.values())
    together = np.zeros((len(counts), longest, *first.shape[1:]), np.float32)
    for index, drive in drives.items():
        together[index, : len(drive)] = drive
        counts[index, STEPS] = len(drive)
    return together


class HybridWorld:
    """World of a scene with a body: `lower` and `upper` gel, and the plasticine between them."""

    sensors: tuple[str, ...] = ("lower", "upper")

    def __init__(self, scene: Scene, state: HybridState | None = None, index: int = 0) -> None:
        """One environment of a `state` made of several scenes, that of scene number `index`; or of one of its own."""
        assert scene.body is not None
        self.scene = scene
        self._state, self._index = HybridState([scene]) if state is None else state, index
        self._gel, self._body = self._state.gel[index], self._state.body[index]
        height = float(extent(scene.body.geometry)[2])
        self._poses = {
            "lower": Pose(),
            "upper": Pose(np.array([0.0, 0.0, height + 2 * CLEARANCE]), HALF_TURN_X.quaternion),
        }
        self._dt = COURANT * min(self._body.cell, self._gel.spacing)
        # penalty of one particle against its share of a gel node: stable whichever of the two is lighter
        share = self._gel.density * self._gel.spacing * self._body.spacing**2 / 2
        reduced = 1.0 / (1.0 / self._body.particle_mass + 1.0 / share)
        self._floor = force_floor(scene.gel.material.youngs_modulus * MPA, self._gel.thickness)
        self._speed = scene.settling.mach  # fastest particle seen in the last launch
        housing = scene.gel.housing
        # Inertia is scaled, weight is not: rho g [1e-9 N/mm^3] over the kernel's density, the P-wave modulus [MPa].
        force = scene.body.material.density * np.array(scene.gravity) * MPA / MM  # [N/mm^3]
        self._weight = force * self._body.volume * len(self._state.particles.x(index))  # [N]
        gravity = force / self._body.density  # [1/mm]
        facts = {
            **self._gel.facts(), **self._body.facts(),
            GEL_DAMPING: ZETA_GEL / self._gel.thickness, BODY_DAMPING: ZETA_BODY / self._gel.thickness,
            # The body's slowest mode is its rigid translation between two soft gels: let it answer as if it were
            # lighter by the number of particle layers. Two contact layers of stiffness ~ m_p / dt^2 then stay below
            # the step limit.
            LIGHTNESS: max(1.0, height * MM / self._body.spacing),
            STIFFNESS: reduced / self._dt**2,
            FRICTION: scene.friction["lower"], FRICTION + 1: scene.friction["upper"],
            HOUSING: -1.0 if housing is None else housing * MM,
            GRAVITY: gravity[0], GRAVITY + 1: gravity[1], GRAVITY + 2: gravity[2],
        }  # fmt: skip
        self._state.facts[index, list(facts)] = list(facts.values())

    # ------------------------------------------------------------------ state

    def _arrays(self) -> dict[str, np.ndarray]:
        state, i = self._state, self._index
        b = state.particles
        return {
            "gel_displacement": state.gels.u[i], "gel_velocity": state.gels.v[i],
            "position": b.x(i), "velocity": b.v(i), "affine": b.c(i), "strain": b.e(i), "flow": b.flow(i),
            "planes": b.plane(i), "contact": state.memory[i, :, : b.counts[i]], "sums": state.partial[i],
        }  # fmt: skip

    def snapshot(self) -> dict[str, np.ndarray]:
        state = taken(self._arrays(), self._poses)
        state["speed"] = np.array(self._speed)
        return state

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        self._poses = put_back(self._arrays(), self.sensors, state)
        self._state.particles.refresh()
        self._speed = float(state["speed"])

    def pose(self, name: str) -> Pose:
        return self._poses[name]

    def wrench(self, name: str) -> np.ndarray:
        first = FORCE + 6 * self.sensors.index(name)
        wrench = self._state.partial[self._index, :, first : first + 6].astype(np.float64).sum(axis=0)
        wrench[3:] /= MM
        return wrench

    def surface(self, name: str) -> GelSurface:
        return gel_surface(self._gel, self._state.gels, self._index, self.sensors.index(name))

    def truth(self) -> Truth:
        x, planes = self._state.particles.x(self._index), self._state.particles.plane(self._index)
        height = float(np.ptp(surface_points(x, planes)[:, 2])) / MM
        return Truth(height, x.mean(axis=0, dtype=np.float64) / MM, (x / MM).astype(np.float32), dict(self._poses))

    # ----------------------------------------------------------------- motion

    def move(self, targets: Mapping[str, Pose], loads: Mapping[str, float] | None = None) -> MoveStats:
        return run(self.motion(targets, loads), self._advance)

    def motion(self, targets: Mapping[str, Pose], loads: Mapping[str, float] | None = None) -> Motion:
        """`move`, a launch at a time."""
        end = merged(self._poses, targets)
        require_loads(loads or {}, self.sensors)
        begin, goals = dict(self._poses), dict(end)

        def tried(refine: int) -> Motion:
            if loads:
                end.update(goals)
                return keep_loads(self, begin, end, loads, refine, balanced=True)
            path = replace(self.plan(list(begin.values()), list(end.values())), refine=refine)
            return move_and_settle(path, self.scene.settling, balanced=True)

        stats = yield from retried(self, targets, tried)
        self._poses = end
        return stats

    def plan(self, start: Sequence[Pose], end: Sequence[Pose]) -> Path:
        """The path between two poses of all driven frames, at the scene's speed."""
        return plan(start, end, self.scene.settling.mach, self._dt, max(self._gel.half))

    def _advance(self, path: Path, first: int, last: int) -> Reading:
        prepared = self.prepare(Launch(path, first, last))
        self._state.advance({self._index: prepared.drive})
        return self.outcome(prepared)

    def prepare(self, launch: Launch) -> Prepared:
        """Lays the grid for a launch and sets this environment's numbers. Raises SimulationDiverged: no room."""
        state, index, path = self._state, self._index, launch.path
        span = (launch.last - launch.first) * self._dt
        weight = float(np.linalg.norm(state.facts[index, GRAVITY : GRAVITY + 3]))
        fall = float(state.facts[index, LIGHTNESS]) * weight * span
        margin = 2 * self._body.cell + 2 * span * max(self._speed + fall, self.scene.settling.mach)
        where = path.place(self._poses, launch.first, launch.last)
        x = state.particles.x(index)
        require_room(x.min(axis=0) - margin, x.max(axis=0) + margin, self._body.cell, where)
        state.particles.fit(index, self._body.cell, margin, state.facts, state.counts)
        good = copies(self._arrays())
        state.facts[index, STEP] = path.step
        Health.clear(state.partial[index])
        return Prepared(launch, path.drive(launch.first, launch.last), where, good)

    def outcome(self, prepared: Prepared) -> Reading:
        """What the launch came to. Raises SimulationDiverged if that is unphysical."""
        partial = self._state.partial[self._index]
        health = judged(self._arrays(), prepared.good, Health.read(partial), prepared.where)
        self._speed = health.fastest
        launch = prepared.launch
        rotations = launch.path.drive(launch.last - 1, launch.last)[-1, :, :3]
        sums = partial.astype(np.float64)
        force, moment = sums[:, FORCE : FORCE + 12].sum(axis=0).reshape(2, 2, 3).swapaxes(0, 1)
        backing = sums[:, BACKING : BACKING + 3].reshape(2, -1, 3).sum(axis=1)  # which holds the housing too
        backing += sums[:, HOUSED : HOUSED + 6].sum(axis=0).reshape(2, 3)
        contact = np.einsum("gij,gj->gi", rotations, force)
        backing = np.einsum("gij,gj->gi", rotations, backing)
        return Reading(
            contact, backing, self._floor, health.overlap, health.capped, moment / max(self._gel.half), self._weight
        )

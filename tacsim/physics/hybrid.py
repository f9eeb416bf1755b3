"""Two gels (FEM in their sensor frames) round a plasticine body (MLS-MPM), coupled by contact with friction memory."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from tacsim.interface import Pose, Truth
from tacsim.physics.contact import contact_ceiling, particle_contact
from tacsim.physics.controller import Motion, Path, Reading, force_floor, merged, move_and_settle, plan, run
from tacsim.physics.gel import MM, MPA, Nodes, gel_advance, gel_facts, gel_forces, gel_state, gel_surface
from tacsim.physics.health import Health, as_float32, attempt, require_room, retried
from tacsim.physics.load import keep_loads, require_loads
from tacsim.physics.material import vec3, vec4
from tacsim.physics.plasticine import (
    Grid,
    Matrices,
    Strains,
    Vectors,
    body_facts,
    body_state,
    clear_grid,
    fit_grid,
    grid_to_particles,
    particles_to_grid,
)
from tacsim.physics.world import MoveStats, put_back, taken
from tacsim.pose import HALF_TURN_X
from tacsim.runtime import start, ti
from tacsim.scene import GelSurface, Scene
from tacsim.shapes import extent, particles

COURANT = 0.4  # dt / (smallest spacing / wave speed)
GEL_DAMPING = 1.0  # zeta in alpha = zeta c / thickness
BODY_DAMPING = 0.4  # zeta in rate = zeta c / gel thickness, against the driven affine motion
CLEARANCE = 0.1e-3  # gap between gels and body at construction [m]

Array1 = ti.types.ndarray(dtype=ti.f32, ndim=1)
Array3 = ti.types.ndarray(dtype=ti.f32, ndim=3)
Array4 = ti.types.ndarray(dtype=ti.f32, ndim=4)
ContactMemory = ti.types.ndarray(dtype=vec4, ndim=2)


@ti.func
def row(drive: ti.template(), it, g, r):
    return vec3(drive[it, g, r, 0], drive[it, g, r, 1], drive[it, g, r, 2])


@ti.func
def rotation(drive: ti.template(), it, g):
    return ti.Matrix.rows([row(drive, it, g, 0), row(drive, it, g, 1), row(drive, it, g, 2)])


@ti.func
def grid_update(grid: ti.template(), origin, cell, drive: ti.template(), it, damping, mean_velocity, boost, dt):
    """Momentum to velocity; damps towards the affine motion that the two sensors impose, not towards rest.

    `boost` is added to every velocity: selective mass scaling of the slowest mode, the rigid translation of a body that
    hangs between two soft gels. Inertia is artificial here anyway; the resting state does not depend on it.

    Across the sensors' axis the reference is the body's own mean velocity while anything is driven: a body that rides
    on one sensor must not be dragged back by the other.
    """
    p0, p1 = row(drive, it, 0, 3), row(drive, it, 1, 3)
    v0, v1 = row(drive, it, 0, 4), row(drive, it, 1, 4)
    w0, w1 = row(drive, it, 0, 5), row(drive, it, 1, 5)
    axis = p1 - p0
    length2 = axis.norm_sqr() + 1e-12
    driven = v0.norm_sqr() + v1.norm_sqr() + w0.norm_sqr() + w1.norm_sqr() > 0.0
    mean_across = mean_velocity - axis * (mean_velocity.dot(axis) / length2)
    for i in range(grid.shape[0]):
        for j in range(grid.shape[1]):
            for k in range(grid.shape[2]):
                q = grid[i, j, k]
                if q[3] > 0.0:
                    velocity = vec3(q[0], q[1], q[2]) / q[3] + boost
                    x = origin + cell * vec3(i, j, k)
                    t = ti.max(0.0, ti.min(1.0, (x - p0).dot(axis) / length2))
                    reference = (1.0 - t) * (v0 + w0.cross(x - p0)) + t * (v1 + w1.cross(x - p1))
                    if driven:
                        reference = axis * (reference.dot(axis) / length2) + mean_across
                    velocity -= damping * dt * (velocity - reference)
                    grid[i, j, k] = vec4(velocity[0], velocity[1], velocity[2], q[3])


@ti.func
def touch(
    g, rotate, it, drive: ti.template(), x: ti.template(), v: ti.template(), memory: ti.template(),
    u: ti.template(), gv: ti.template(), gf: ti.template(), h, mass, radius, k_n, mu, housing, dt,
    health: ti.template(),
):  # fmt: skip
    """Contact of every particle with gel g. Returns force and moment of the body on the sensor, sensor axes."""
    origin, velocity, spin = row(drive, it, g, 3), row(drive, it, g, 4), row(drive, it, g, 5)
    back = rotate.transpose()
    outward = vec3(rotate[0, 2], rotate[1, 2], rotate[2, 2])  # the sensor's z axis
    highest = contact_ceiling(u, g, radius)
    total, moment = vec3(0.0), vec3(0.0)
    for p in range(x.shape[0]):
        arm = x[p] - origin
        kept = vec4(0.0)
        if outward.dot(arm) < highest:  # most of the body is far away: one dot product decides
            local = back @ arm
            relative = back @ (v[p] - velocity - spin.cross(arm))
            touching, force, kept_now, overlap = particle_contact(
                g, local, relative, memory[g, p], u, gv, gf, h, radius, k_n, mu, housing, dt, health
            )
            kept = kept_now
            if touching:
                v[p] = v[p] + (dt / mass) * (rotate @ force)
                total -= force
                moment -= local.cross(force)
                health[5] = ti.max(health[5], overlap)
        memory[g, p] = kept
    return total, moment


@ti.kernel
def substeps(
    n: ti.i32, dt: ti.f32, drive: Array4,
    u: Nodes, gv: Nodes, gf: Nodes, h: ti.f32, gel_mu: ti.f32, gel_lam: ti.f32, gel_damping: ti.f32,
    x: Vectors, v: Vectors, c: Matrices, e: Strains, memory: ContactMemory, mean: Array1,
    grid: Grid, ox: ti.f32, oy: ti.f32, oz: ti.f32, spacing: ti.f32,
    mu: ti.f32, bulk: ti.f32, limit: ti.f32, body_damping: ti.f32, lightness: ti.f32,
    k_n: ti.f32, friction_lower: ti.f32, friction_upper: ti.f32, housing: ti.f32,
    wrench: Array3, backing: ti.types.ndarray(dtype=ti.f32, ndim=2), health: Array1,
):  # fmt: skip
    """n explicit substeps of the whole scene in one launch; serial, plain adds, bitwise repeatable."""
    ti.loop_config(serialize=True)
    for it in range(n):
        cell, volume = 2.0 * spacing, spacing * spacing * spacing
        mass = (bulk + 4.0 / 3.0 * mu) * volume
        origin = vec3(ox, oy, oz)
        health[5] = 0.0
        push = vec3(0.0)  # total contact force on the body, world axes
        for g in range(2):
            rotate = rotation(drive, it, g)
            friction = friction_lower if g == 0 else friction_upper
            force, moment = touch(
                g,
                rotate,
                it,
                drive,
                x,
                v,
                memory,
                u,
                gv,
                gf,
                h,
                mass,
                0.5 * spacing,
                k_n,
                friction,
                housing,
                dt,
                health,
            )
            gel_forces(g, u, gf, h, gel_mu, gel_lam, health)
            held = rotate @ gel_advance(g, u, gv, gf, h, gel_lam + 2.0 * gel_mu, gel_damping, dt)
            push -= rotate @ force
            for d in ti.static(range(3)):
                wrench[g, 0, d] = force[d]
                wrench[g, 1, d] = moment[d]
                backing[g, d] = held[d]
        clear_grid(grid)
        particles_to_grid(x, v, c, e, grid, origin, cell, mass, volume, mu, bulk, limit, dt, health)
        boost = ((lightness - 1.0) * dt / (mass * x.shape[0])) * push
        grid_update(grid, origin, cell, drive, it, body_damping, vec3(mean[0], mean[1], mean[2]), boost, dt)
        total = grid_to_particles(x, v, c, e, grid, origin, cell, dt, health)
        for d in ti.static(range(3)):
            mean[d] = total[d] / x.shape[0]


class HybridWorld:
    """World of a scene with a body: `lower` and `upper` gel, and the plasticine between them."""

    sensors: tuple[str, ...] = ("lower", "upper")

    def __init__(self, scene: Scene) -> None:
        assert scene.body is not None
        start()
        self.scene = scene
        self._gel = gel_facts(scene.gel, scene.element)
        self._body = body_facts(scene.body.material, scene.spacing)
        self._gels = gel_state(self._gel, 2)
        height = float(extent(scene.body.geometry)[2])
        points = (particles(scene.body.geometry, scene.spacing) + [0.0, 0.0, height / 2 + CLEARANCE]) * MM
        self._particles = body_state(points)
        self._memory = np.zeros((2, len(points), 4), np.float32)  # of the contact law, sensor frames [mm]
        self._mean = np.zeros(3, np.float32)  # the body's mean velocity
        self._wrench = np.zeros((2, 2, 3), np.float32)
        self._backing = np.zeros((2, 3), np.float32)
        self._poses = {
            "lower": Pose(),
            "upper": Pose(np.array([0.0, 0.0, height + 2 * CLEARANCE]), HALF_TURN_X.quaternion),
        }
        self._dt = COURANT * min(self._body.cell, self._gel.spacing)
        # penalty of one particle against its share of a gel node: stable whichever of the two is lighter
        share = self._gel.density * self._gel.spacing * self._body.spacing**2 / 2
        reduced = 1.0 / (1.0 / self._body.particle_mass + 1.0 / share)
        self._stiffness = reduced / self._dt**2
        # The body's slowest mode is its rigid translation between two soft gels: let it answer as if it were lighter by
        # the number of particle layers. Two contact layers of stiffness ~ m_p / dt^2 then stay below the step limit.
        self._lightness = max(1.0, height * MM / self._body.spacing)
        self._floor = force_floor(scene.gel.material.youngs_modulus * MPA, self._gel.thickness)
        self._grid = np.zeros((1, 1, 1, 4), np.float32)
        self._speed = scene.settling.mach  # fastest particle seen in the last launch
        as_float32(list(self._arrays().values()))

    # ------------------------------------------------------------------ state

    def _arrays(self) -> dict[str, np.ndarray]:
        b = self._particles
        return {
            "gel_displacement": self._gels.u, "gel_velocity": self._gels.v, "gel_force": self._gels.f,
            "position": b.x, "velocity": b.v, "affine": b.c, "strain": b.e, "contact": self._memory,
            "mean_velocity": self._mean, "wrench": self._wrench, "backing": self._backing,
        }  # fmt: skip

    def snapshot(self) -> dict[str, np.ndarray]:
        state = taken(self._arrays(), self._poses)
        state["speed"] = np.array(self._speed)
        return state

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        self._poses = put_back(self._arrays(), self.sensors, state)
        self._speed = float(state["speed"])

    def pose(self, name: str) -> Pose:
        return self._poses[name]

    def wrench(self, name: str) -> np.ndarray:
        force, moment = self._wrench[self.sensors.index(name)].astype(np.float64)
        return np.concatenate([force, moment / MM])

    def surface(self, name: str) -> GelSurface:
        return gel_surface(self._gel, self._gels, self.sensors.index(name))

    def truth(self) -> Truth:
        x = self._particles.x
        z = x[:, 2]
        height = (float(z.max()) - float(z.min()) + self._body.spacing) / MM
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
        return plan(start, end, self.scene.settling.mach, self._dt, max(self._gel.half), self._gel.thickness)

    def _advance(self, path: Path, first: int, last: int) -> Reading:
        span = (last - first) * self._dt
        margin = 2 * self._body.cell + 2 * span * max(self._speed, self.scene.settling.mach)
        where = path.place(self._poses, first, last)
        x = self._particles.x
        require_room(x.min(axis=0) - margin, x.max(axis=0) + margin, self._body.cell, where)
        origin, shape = fit_grid(x, self._body.cell, margin)
        if self._grid.shape[:3] != shape:
            self._grid = np.zeros((*shape, 4), np.float32)

        def launch() -> Health:
            health = Health.array()
            self._launch(path.drive(first, last), path.step, origin, health)
            return Health.read(health)

        health = attempt(self._arrays(), launch, where)
        self._speed = health.fastest
        rotations = path.drive(last - 1, last)[-1, :, :3]
        contact = np.einsum("gij,gj->gi", rotations, self._wrench[:, 0]).astype(np.float64)
        moment = self._wrench[:, 1].astype(np.float64) / max(self._gel.half)
        return Reading(contact, self._backing.astype(np.float64), self._floor, health.overlap, health.capped, moment)

    def _launch(self, drive: np.ndarray, dt: float, origin: np.ndarray, health: np.ndarray) -> None:
        g, b, gel, body = self._gels, self._particles, self._gel, self._body
        housing = self.scene.gel.housing
        substeps(
            len(drive), dt, drive,
            g.u, g.v, g.f, gel.spacing, gel.mu, gel.lam, GEL_DAMPING / gel.thickness,
            b.x, b.v, b.c, b.e, self._memory, self._mean,
            self._grid, *(float(o) for o in origin), body.spacing, body.mu, body.bulk, body.limit,
            BODY_DAMPING / gel.thickness, self._lightness,
            self._stiffness, self.scene.friction["lower"], self.scene.friction["upper"],
            -1.0 if housing is None else housing * MM,
            self._wrench, self._backing, health,
        )  # fmt: skip

"""Small kernels that run the laws, transfers and elements of tacsim.physics with the boundary conditions of a closed
form, which no World has. Units as in the physics: mm, N, MPa, wave speed 1."""

import numpy as np

from tacsim.compute.runtime import start_taichi, ti
from tacsim.physics.body.material import hencky_return, mat3, transport_strain, vec6
from tacsim.physics.body.plasticine import BodyParams, BodyState
from tacsim.physics.body.transfers import (
    Body,
    Strips,
    clear_masses,
    grid_to_particles,
    node_sum,
    particles_to_grid,
)
from tacsim.physics.exec import layout
from tacsim.physics.exec.environment import Counts, Environment, Floats, Params, Partial
from tacsim.physics.exec.lanes import LANES, NODES, PARTS, share_start, strip, vec3
from tacsim.physics.exec.team import (
    CHUNK,
    Sync,
    claim_work,
    first_in_chunk,
    first_own_part,
    one_if,
    report_work_done,
    run_team,
)
from tacsim.physics.gel.gel import GelParams, GelState
from tacsim.physics.gel.kernels import Gels, Lattice, first_node, gel_advance, gel_forces, gel_of
from tacsim.physics.gel.tuning import MIN_VOLUME_RATIO

Steps = ti.types.ndarray(dtype=ti.i32, ndim=2)
Scalars = ti.types.ndarray(dtype=ti.f32, ndim=1)
Symmetric = ti.types.ndarray(dtype=vec6, ndim=1)


@ti.kernel
def body_substeps(
    team: ti.i32, steps: Steps,
    particles: Floats, masses: Strips, velocities: Strips,
    params: Params, counts: Counts, partial: Partial, keep_x: ti.f32, keep_y: ti.f32, keep_z: ti.f32, sync: Sync,
):  # fmt: skip
    """A free body without damping; `keep` 0 forbids motion along an axis, 1 allows it. Threads share the work as in
    tacsim.physics.worlds.hybrid_kernels."""
    for task in range(team * CHUNK):
        for _ in range(first_in_chunk(task)):
            env = ti.static(Environment(0, params, counts, partial))
            body = ti.static(Body(particles, masses, velocities))
            rows, plane = env.count(layout.GRID), env.count(layout.GRID + 1) * (env.count(layout.GRID + 2) // NODES)
            stages, own = 2 * steps.shape[1] + 1, first_own_part(task, team)
            piece = claim_work(sync, 0, own, stages)
            while piece < stages * PARTS:
                stage, part = piece // PARTS, piece % PARTS
                for _gather in range(one_if(stage % 2 == 0 and stage > 0)):
                    grid_to_particles(env, part, body)
                for _scatter in range(one_if(stage % 2 == 0 and stage < 2 * steps.shape[1])):
                    clear_masses(env, part, body)
                    particles_to_grid(env, part, 0, body)
                for _motion in range(one_if(stage % 2 == 1)):
                    for i in range(share_start(rows, part, PARTS), share_start(rows, part + 1, PARTS)):
                        for at in range(i * plane, (i + 1) * plane):
                            q = node_sum(env, i, at, body)
                            moved = strip(0.0)
                            for n in ti.static(range(NODES)):
                                if q[4 * n + 3] > 0.0:
                                    moved[4 * n] = keep_x * q[4 * n] / q[4 * n + 3]
                                    moved[4 * n + 1] = keep_y * q[4 * n + 1] / q[4 * n + 3]
                                    moved[4 * n + 2] = keep_z * q[4 * n + 2] / q[4 * n + 3]
                            velocities[at] = moved
                report_work_done(sync, 0)
                piece = claim_work(sync, 0, own, stages)


@ti.kernel
def gel_substeps(
    nodes: Floats, surface: Floats, contact_force: Floats, corners: Floats, lattice: Lattice,
    params: Params, counts: Counts, partial: Partial,
    keep_x: ti.f32, keep_y: ti.f32, keep_z: ti.f32, driven: ti.i32, speed: ti.f32,
):  # fmt: skip
    """A gel on its backing; `keep` as above. If `driven`, the top moves along z with `speed`."""
    ti.loop_config(serialize=True)
    for _ in range(counts[0, layout.STEPS]):
        env = ti.static(Environment(0, params, counts, partial))
        gels = ti.static(Gels(nodes, surface, contact_force, corners, lattice, 1))
        gel = ti.static(gel_of(env, gels, 0))
        nx, ny, layers = gel.nx, gel.ny, gel.layers
        for part in range(PARTS):
            gel_forces(env, part, gels)
        for part in range(PARTS):
            gel_advance(env, part, gels)
        layer = ((nx + 1) * (ny + 1) + LANES - 1) // LANES * LANES
        dt, keep = env.param(layout.STEP), vec3(keep_x, keep_y, keep_z)
        for d in ti.static(range(3)):
            for k in range(1, layers + 1):
                for n in range((nx + 1) * (ny + 1)):
                    v = first_node(env, gel) + ((3 + d) * (layers + 1) + k) * layer + n
                    before = nodes[v]
                    after = keep[d] * before
                    if driven == 1 and k == layers and d == 2:
                        after = speed
                    nodes[v] = after
                    nodes[v - 3 * (layers + 1) * layer] += dt * (after - before)


@ti.kernel
def shear_points(
    n: ti.i32, step: ti.f32, e: Symmetric, flow: Scalars, tau: Symmetric, mu: ti.f32, bulk: ti.f32, limit: ti.f32,
    hardening: ti.f32,
):  # fmt: skip
    """Material points in simple shear: n increments of d(v_x)/dy, each followed by the return mapping."""
    for p in range(e.shape[0]):
        for _ in range(n):
            moved = transport_strain(e[p], mat3([[0.0, step, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
            elastic, new_flow, stress = hencky_return(moved, flow[p], mu, bulk, limit, hardening)
            e[p] = elastic
            flow[p] = new_flow
            tau[p] = stress


class Block:
    """Base of a single body or gel: the arrays that it shares with its kernel."""

    def __init__(self, params: dict[int, float], dt: float) -> None:
        start_taichi(cpu_only="a single block of a material (tacsim bench materials)")
        self.params = np.zeros((1, layout.PARAMS), np.float32)
        self.params[0, list(params)] = list(params.values())
        self.params[0, layout.STEP] = dt
        self.counts = np.zeros((1, layout.COUNTS), np.int32)
        self.partial = np.zeros((1, PARTS, layout.NUMBERS), np.float32)
        self.partial[:, :, [layout.SMALLEST_VOLUME, layout.SMALLEST_STEP_VOLUME]] = 1.0


class BodyBlock(Block):
    """A free body of particles (n, 3) [mm], no damping, time step dt [mm]."""

    def __init__(self, params: BodyParams, points: np.ndarray, dt: float) -> None:
        super().__init__(params.params(), dt)
        self.cell = params.cell
        self.state = BodyState([points])

    def fit(self, margin: float) -> None:
        """Fits the grid to the present particles, with a margin [mm] of at least a cell."""
        self.state.move_reference(0)
        self.state.fit_grid(0, self.cell, margin, self.params, self.counts)

    def advance(self, substeps: int, keep: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> None:
        """keep: 0 forbids motion along an axis, 1 allows it. Raises RuntimeError if a particle left the grid."""
        steps = np.zeros((1, substeps), np.int32)
        run_team(body_substeps, steps, *self.state.arguments(), self.params, self.counts, self.partial, *keep)
        if self.partial[0, :, layout.OFF_GRID].any():
            raise RuntimeError("particles left the grid of a body block: fit it again, or with a wider margin")


class GelBlock(Block):
    """A gel on its backing without contact; damping rate [1/mm], time step dt [mm]."""

    def __init__(self, params: GelParams, dt: float, damping: float) -> None:
        super().__init__({**params.params(), layout.GEL_DAMPING: damping}, dt)
        self.state = GelState([params], 1)
        self.state.write_layout(self.counts)
        self._arguments = (*self.state.arguments(), self.params, self.counts, self.partial)

    def advance(self, substeps: int, keep: tuple[float, float, float], speed: float | None = None) -> None:
        """keep: as for a body; speed: of the top along z, if driven. Raises RuntimeError if an element inverts."""
        self.counts[0, layout.STEPS] = substeps
        gel_substeps(*self._arguments, *keep, int(speed is not None), speed or 0.0)
        smallest = float(self.partial[0, :, layout.SMALLEST_VOLUME].min())
        if not smallest > MIN_VOLUME_RATIO:
            raise RuntimeError(f"an element of a gel block shrank to {smallest:.3g} of its volume: reduce its motion")

    @property
    def backing(self) -> np.ndarray:
        """Force of the gel on its backing in the last substep [N], (3,)."""
        return self.partial[0, :, layout.BACKING : layout.BACKING + 3].sum(axis=0, dtype=np.float64)

"""Kernels of the seed scheme: one shared MLS-MPM grid for gels and plasticine.

Stages of a substep, named as in the paper: particle to grid, grid to particle (update F, return mapping), advection.
Transfers are APIC with quadratic B-splines (Hu et al. 2018, "A moving least squares material point method").
Units: mm, N, MPa; densities are scaled so that the pressure wave speed is 1, hence time is in mm.

All particles lie in one array: lower gel, upper gel, body. Loops are serial and adds are plain: bitwise repeatable.
"""

from typing import Any, NamedTuple

from tacsim.compute.runtime import ti
from tacsim.physics.body.material import UNREACHABLE_LIMIT, full_matrix, stress_small_strain, vec6

f32 = ti.f32
Vec3 = ti.types.vector(3, f32)
Vec4 = ti.types.vector(4, f32)
Mat3 = ti.types.matrix(3, 3, f32)

Flags = ti.types.ndarray(dtype=ti.i32, ndim=1)
Positions = ti.types.ndarray(dtype=ti.types.vector(3, ti.f64), ndim=1)  # a settling gel moves by less than f32 resolves
Scalars = ti.types.ndarray(dtype=f32, ndim=1)
Vectors = ti.types.ndarray(dtype=Vec3, ndim=1)
Matrices = ti.types.ndarray(dtype=Mat3, ndim=1)
GridNodes = ti.types.ndarray(dtype=Vec4, ndim=3)  # momentum, then velocity; mass
Drive = ti.types.ndarray(dtype=f32, ndim=4)  # [substep, sensor, row, xyz] of tacsim.physics.motion.path.Path
Table = ti.types.ndarray(dtype=f32, ndim=2)

PAD = 2  # node planes behind each backing plane
SWEEPS = 3  # of the Jacobi SVD: enough for f32 accuracy up to strains of 1


@ti.dataclass
class Solid:
    """Constants of one material, per particle."""

    mass: f32
    volume: f32
    mu: f32
    lam: f32
    limit: f32  # |dev e|_F at yield, sigma_y / (2 mu); UNREACHABLE_LIMIT for a body that never yields


@ti.dataclass
class Step:
    """Constants of one launch."""

    dt: f32
    dx: f32  # node spacing in x and y; in z see `vertical`
    x0: f32  # world x, y of node (0, 0)
    y0: f32
    thickness: f32  # of a gel
    reach: f32  # a gel and a body closer than this touch
    gel_damping: f32  # rate [1/mm]
    body_damping: f32  # along z
    lateral_damping: f32  # of the body, along x and y
    cells: ti.i32  # node layers between the two backing planes
    gels: ti.i32  # particles of one gel


class Particles(NamedTuple):
    """All particles inside a kernel (docs/decisions/0012): positions, velocities, APIC matrices, deformation gradients,
    Kirchhoff stresses, and flags of those that have left the grid."""

    x: Any
    v: Any
    C: Any
    F: Any
    stress: Any
    aside: Any


class Grid(NamedTuple):
    """The grid inside a kernel, and its place in this substep."""

    nodes: Any
    origin: Any
    spacing: Any


@ti.func
def drive_row(drive: ti.template(), n, sensor, r):
    return Vec3(drive[n, sensor, r, 0], drive[n, sensor, r, 1], drive[n, sensor, r, 2])


@ti.func
def surface_origin(drive: ti.template(), n, sensor, dt):
    """Sensor origin (the gel's rest surface) at the start of substep n; the drive table has the end."""
    return drive_row(drive, n, sensor, 3) - dt * drive_row(drive, n, sensor, 4)


@ti.func
def driven_velocity(drive: ti.template(), n, sensor, at, dt):
    """Velocity of a sensor's rigid frame at `at`, from the chord of its rotation (series in the small angle), which
    keeps radii."""
    r = at - surface_origin(drive, n, sensor, dt)
    spin = drive[n, sensor, 5, 2]
    angle = spin * dt
    along, inward = spin * (1.0 - angle * angle / 6.0), 0.5 * spin * angle
    return drive_row(drive, n, sensor, 4) + Vec3(-along * r[1] - inward * r[0], along * r[0] - inward * r[1], 0.0)


@ti.func
def vertical_grid(drive: ti.template(), n, step):
    """Origin and spacing of the grid in z: both backing planes lie on node planes, so gels do not slip on them.

    With a backing plane that moves through the nodes of a fixed grid, the gel could slip by up to a cell.
    """
    low = surface_origin(drive, n, 0, step.dt)[2] - step.thickness
    high = surface_origin(drive, n, 1, step.dt)[2] + step.thickness
    spacing = (high - low) / step.cells
    return low - PAD * spacing, spacing


@ti.func
def spline_weights(fx):
    """Quadratic B-spline weights of the three nodes, one row a node."""
    return ti.Matrix.rows([0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2])


@ti.func
def is_inside_grid(X, nodes: ti.template()):
    """Whether the stencil of a particle at grid coordinates X lies in the grid; False for NaN."""
    ok = X[0] > 0.5 and X[1] > 0.5 and X[2] > 0.5
    return ok and X[0] < nodes.shape[0] - 1.5 and X[1] < nodes.shape[1] - 1.5 and X[2] < nodes.shape[2] - 1.5


@ti.func
def column_rotation(a, b):
    """Cosine and sine of the Jacobi rotation that makes two columns orthogonal."""
    gap, dot = b.dot(b) - a.dot(a), 2.0 * a.dot(b)
    t = dot / (ti.abs(gap) + ti.sqrt(gap * gap + dot * dot) + 1e-30)
    t = ti.select(gap < 0.0, -t, t)
    c = 1.0 / ti.sqrt(1.0 + t * t)
    return c, c * t


@ti.func
def left_singular(F):
    """U and S of F = U S V^T by one-sided Jacobi rotations of the columns (Hestenes 1958); S positive, unsorted."""
    b0, b1, b2 = Vec3(F[0, 0], F[1, 0], F[2, 0]), Vec3(F[0, 1], F[1, 1], F[2, 1]), Vec3(F[0, 2], F[1, 2], F[2, 2])
    for _ in ti.static(range(SWEEPS)):
        c, s = column_rotation(b0, b1)
        b0, b1 = c * b0 - s * b1, s * b0 + c * b1
        c, s = column_rotation(b0, b2)
        b0, b2 = c * b0 - s * b2, s * b0 + c * b2
        c, s = column_rotation(b1, b2)
        b1, b2 = c * b1 - s * b2, s * b1 + c * b2
    S = Vec3(b0.norm(), b1.norm(), b2.norm())
    return ti.Matrix.cols([b0 / S[0], b1 / S[1], b2 / S[2]]), S


@ti.func
def from_principal_values(U, values):
    """U diag(values) U^T."""
    scaled = U
    for a, b in ti.static(ti.ndrange(3, 3)):
        scaled[a, b] = U[a, b] * values[b]
    return scaled @ U.transpose()


@ti.func
def return_mapping(F, solid):
    """Seed paper, eq. (1)-(2): Hencky strain e = log S; beyond yield dev e shrinks by dg = |dev e| - sigma_y / (2 mu).

    Returns the elastic F = U exp(e - dg dev e/|dev e|) V^T, and the Kirchhoff stress U (2 mu e + lambda tr e) U^T.
    """
    U, S = left_singular(F)
    e = ti.log(S)
    mean = e.sum() / 3.0
    dev = e - mean
    norm = dev.norm()
    dg = norm - solid.limit
    elastic = F
    if dg > 0.0:
        flow = (dg / norm) * dev
        elastic = from_principal_values(U, ti.exp(-flow)) @ F  # V^T = S^-1 U^T F, so V itself is not needed
        e -= flow
    return elastic, from_principal_values(U, 2.0 * solid.mu * e + 3.0 * solid.lam * mean)


@ti.func
def finger_strain(F):
    """F F^T - I as 6 numbers, from F - I: small strains keep their digits."""
    d = F
    for a in ti.static(range(3)):
        d[a, a] -= 1.0
    e = d + d.transpose() + d @ d.transpose()
    return vec6(e[0, 0], e[1, 1], e[2, 2], e[0, 1], e[0, 2], e[1, 2])


@ti.func
def body_law(F, solid):
    """Elastic F and Kirchhoff stress of the body. A body that never yields needs no return mapping, and up to a strain
    of about 0.2 no singular values (tacsim.physics.body.material)."""
    elastic = F
    tau = Mat3(0.0)
    large = 1
    if solid.limit >= UNREACHABLE_LIMIT:
        near, large = stress_small_strain(finger_strain(F), solid.mu, solid.lam + 2.0 / 3.0 * solid.mu)
        tau = full_matrix(near)
    if large != 0:
        elastic, tau = return_mapping(F, solid)
    return elastic, tau


@ti.func
def neo_hookean(F, solid):
    """Kirchhoff stress of the gel, mu (F F^T - I) + lambda ln J I."""
    tau = solid.mu * (F @ F.transpose())
    pressure = solid.lam * ti.log(F.determinant()) - solid.mu
    for a in ti.static(range(3)):
        tau[a, a] += pressure
    return tau


@ti.func
def particle_to_grid(particles: ti.template(), grid: ti.template(), step, gel, body, health: ti.template()):
    """Scatters momentum, mass and the impulse of stress; flags particles outside the grid, which are left out."""
    for p in range(particles.x.shape[0]):
        X = ti.cast((particles.x[p] - grid.origin) / grid.spacing, f32)
        if particles.aside[p] == 0 and not is_inside_grid(X, grid.nodes):
            particles.aside[p] = 1
            if p < 2 * step.gels:
                health[1] += 1.0
        if particles.aside[p] == 0:
            base = ti.floor(X - 0.5, ti.i32)
            fx = X - base
            w = spline_weights(fx)
            mass, volume = gel.mass, gel.volume
            if p >= 2 * step.gels:
                mass, volume = body.mass, body.volume
            affine, push = mass * particles.C[p], -4.0 * step.dt * volume * particles.stress[p]
            for a, b in ti.static(ti.ndrange(3, 3)):
                affine[a, b] = affine[a, b] * grid.spacing[b] + push[a, b] / grid.spacing[b]
            start = mass * particles.v[p] - affine @ fx
            q0 = Vec4(start[0], start[1], start[2], mass)
            ax = Vec4(affine[0, 0], affine[1, 0], affine[2, 0], 0.0)
            ay = Vec4(affine[0, 1], affine[1, 1], affine[2, 1], 0.0)
            az = Vec4(affine[0, 2], affine[1, 2], affine[2, 2], 0.0)
            for i, j in ti.static(ti.ndrange(3, 3)):
                qij = q0 + ax * float(i) + ay * float(j)
                wij = w[i, 0] * w[j, 1]
                for k in ti.static(range(3)):
                    node = base + ti.Vector([i, j, k])
                    grid.nodes[node] = grid.nodes[node] + (wij * w[k, 2]) * (qij + az * float(k))


@ti.func
def update_grid(grid: ti.template(), drive: ti.template(), n, step, backing: ti.template()):
    """Momentum -> velocity; nodes on and behind a backing plane move with their sensor and transfer their momentum to
    it.

    `backing`: force and torque on each sensor, about its origin, world axes.
    """
    for s, a in ti.ndrange(2, 6):
        backing[s, a] = 0.0
    for i, j, k in ti.ndrange(grid.nodes.shape[0], grid.nodes.shape[1], grid.nodes.shape[2]):
        q = grid.nodes[i, j, k]
        if q[3] > 0.0:
            u = Vec3(q[0], q[1], q[2]) / q[3]
            if k <= PAD or k >= PAD + step.cells:
                s = ti.select(k <= PAD, 0, 1)
                at = grid.origin + grid.spacing * Vec3(i, j, k)
                driven = driven_velocity(drive, n, s, at, step.dt)
                force = (q[3] / step.dt) * (u - driven)
                torque = (at - surface_origin(drive, n, s, step.dt)).cross(force)
                for a in ti.static(range(3)):
                    backing[s, a] += force[a]
                    backing[s, a + 3] += torque[a]
                u = driven
            grid.nodes[i, j, k] = Vec4(u[0], u[1], u[2], q[3])


@ti.func
def grid_to_particle(particles: ti.template(), grid: ti.template(), step, gel, body, health: ti.template()):
    """Gathers velocity and its gradient C, updates F <- (I + dt C) F, maps it back to the yield surface."""
    for p in range(particles.x.shape[0]):
        if particles.aside[p] == 0:
            X = ti.cast((particles.x[p] - grid.origin) / grid.spacing, f32)
            base = ti.floor(X - 0.5, ti.i32)
            fx = X - base
            w = spline_weights(fx)
            velocity = Vec3(0.0)
            gradient = Mat3(0.0)
            for i, j in ti.static(ti.ndrange(3, 3)):
                line, slope = Vec3(0.0), Vec3(0.0)
                for k in ti.static(range(3)):
                    q = grid.nodes[base + ti.Vector([i, j, k])]
                    u = (w[i, 0] * w[j, 1] * w[k, 2]) * Vec3(q[0], q[1], q[2])
                    line += u
                    slope += u * (k - fx[2])
                velocity += line
                for a in ti.static(range(3)):
                    gradient[a, 0] += line[a] * (i - fx[0])
                    gradient[a, 1] += line[a] * (j - fx[1])
                    gradient[a, 2] += slope[a]
            for a, b in ti.static(ti.ndrange(3, 3)):
                gradient[a, b] *= 4.0 / grid.spacing[b]
            particles.v[p] = velocity
            particles.C[p] = gradient
            update = step.dt * gradient
            for a in ti.static(range(3)):
                update[a, a] += 1.0
            trial = update @ particles.F[p]
            if p < 2 * step.gels:
                particles.F[p] = trial
                particles.stress[p] = neo_hookean(trial, gel)
                health[0] = ti.min(health[0], trial.determinant())
            else:
                elastic, tau = body_law(trial, body)
                particles.F[p] = elastic
                particles.stress[p] = tau
            health[2] = ti.min(health[2], update.determinant())
            health[3] = ti.max(health[3], velocity.norm())


@ti.func
def body_reference(drive: ti.template(), n, z, motion: ti.template(), step):
    """Velocity of a body without inertia at height z; damping acts relative to it.

    `motion`: mean velocity (3), lowest and highest z of the body one substep ago. Between two touching gels: along z
    linear from one sensor to the other, laterally the body's mean; on one gel: that sensor's velocity; on none: zero.
    """
    low, high = surface_origin(drive, n, 0, step.dt)[2], surface_origin(drive, n, 1, step.dt)[2]
    on_low, on_high = motion[3] - low < step.reach, high - motion[4] < step.reach
    v_low, v_high = drive_row(drive, n, 0, 4), drive_row(drive, n, 1, 4)
    velocity = Vec3(0.0)
    if on_low and on_high:
        share = ti.min(ti.max((z - low) / (high - low), 0.0), 1.0)
        velocity = (1.0 - share) * v_low + share * v_high
        if v_low.norm_sqr() + v_high.norm_sqr() > 0.0:
            velocity[0], velocity[1] = motion[0], motion[1]
    elif on_low:
        velocity = v_low
    elif on_high:
        velocity = v_high
    return velocity


@ti.func
def advection(
    particles: ti.template(), drive: ti.template(), n, step, gel, motion: ti.template(), momentum: ti.template(),
    gain: ti.template(),
):  # fmt: skip
    """Moves the particles, then damps their velocity (after the forces are measured).

    `gain`: momentum change of each gel in this substep before damping, per time: contact minus backing force.
    """
    mean, lowest, highest, count = Vec3(0.0), 1e30, -1e30, 0
    for s in range(2):
        before, after = Vec3(0.0), Vec3(0.0)
        for p in range(s * step.gels, (s + 1) * step.gels):
            if particles.aside[p] == 0:
                particles.x[p] = particles.x[p] + step.dt * ti.cast(particles.v[p], ti.f64)
                at = ti.cast(particles.x[p], f32)
                before += particles.v[p]
                driven = driven_velocity(drive, n, s, at, step.dt)
                particles.v[p] = particles.v[p] - step.gel_damping * step.dt * (particles.v[p] - driven)
                after += particles.v[p]
        for a in ti.static(range(3)):
            gain[s, a] = gel.mass * (before[a] - momentum[s, a]) / step.dt
            momentum[s, a] = after[a]
    for p in range(2 * step.gels, particles.x.shape[0]):
        if particles.aside[p] == 0:
            particles.x[p] = particles.x[p] + step.dt * ti.cast(particles.v[p], ti.f64)
            at = ti.cast(particles.x[p], f32)
            mean += particles.v[p]
            count += 1
            lowest, highest = ti.min(lowest, at[2]), ti.max(highest, at[2])
            excess = particles.v[p] - body_reference(drive, n, at[2], motion, step)
            rate = Vec3(step.lateral_damping, step.lateral_damping, step.body_damping)
            particles.v[p] = particles.v[p] - step.dt * rate * excess
    if count > 0:
        for a in ti.static(range(3)):
            motion[a] = mean[a] / count
        motion[3], motion[4] = lowest, highest


@ti.kernel
def advance(
    x: Positions, v: Vectors, C: Matrices, F: Matrices, stress: Matrices, aside: Flags, nodes: GridNodes, drive: Drive,
    motion: Scalars, momentum: Table, gain: Table, backing: Table, health: Scalars, gel: Solid, body: Solid, step: Step,
):  # fmt: skip
    """Many substeps of the whole scene in one launch, one for each row of `drive`."""
    ti.loop_config(serialize=True)
    for n in range(drive.shape[0]):
        z0, dz = vertical_grid(drive, n, step)
        particles = ti.static(Particles(x, v, C, F, stress, aside))
        origin, spacing = Vec3(step.x0, step.y0, z0), Vec3(step.dx, step.dx, dz)
        grid = ti.static(Grid(nodes, origin, spacing))
        for node in ti.grouped(ti.ndrange(nodes.shape[0], nodes.shape[1], nodes.shape[2])):
            nodes[node] = Vec4(0.0)
        particle_to_grid(particles, grid, step, gel, body, health)
        update_grid(grid, drive, n, step, backing)
        grid_to_particle(particles, grid, step, gel, body, health)
        advection(particles, drive, n, step, gel, motion, momentum, gain)

"""Gel elements against the float64 reference and closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchmarks.truth import laws
from tacsim.compute.runtime import start_taichi, ti
from tacsim.models.material import GelMaterial
from tacsim.models.scene import Gel
from tacsim.physics.exec.environment import Counts, Environment, Floats, Params, Partial
from tacsim.physics.exec.lanes import PARTS
from tacsim.physics.exec.layout import (
    BACKING,
    COUNTS,
    FILTERED_WEIGHT,
    GEL_DAMPING,
    NUMBERS,
    OWN_WEIGHT,
    PARAMS,
    SMALLEST_VOLUME,
    STEP,
)
from tacsim.physics.gel.gel import GelState, gel_params
from tacsim.physics.gel.kernels import (
    Gels,
    Lattice,
    gel_advance,
    gel_forces,
)
from tacsim.physics.gel.mass import gel_advance_filtered, gel_filter_first_pass, gel_means
from tacsim.physics.gel.tuning import CORNER_STIFFNESS, HOURGLASS_STIFFNESS, MIN_CORNER_RATIO

pytestmark = pytest.mark.cpu


FORCES, PLAIN, SELECTIVE = 0, 1, 2  # of a substep


@ti.kernel
def substep(
    number: ti.template(), advance: ti.i32,
    nodes: Floats, surface: Floats, contact_force: Floats, corners: Floats, lattice: Lattice,
    params: Params, counts: Counts, partial: Partial,
):  # fmt: skip
    ti.loop_config(serialize=True)
    for e in range(counts.shape[0]):
        env = ti.static(Environment(e, params, counts, partial))
        gels = ti.static(Gels(nodes, surface, contact_force, corners, lattice, number))
        for part in range(PARTS):
            gel_forces(env, part, gels)
        for part in range(PARTS * (advance == PLAIN)):
            gel_advance(env, part, gels)
        for part in range(PARTS * (advance == SELECTIVE)):
            gel_means(env, part, gels)
        for part in range(PARTS * (advance == SELECTIVE)):
            gel_filter_first_pass(env, part, gels)
        for part in range(PARTS * (advance == SELECTIVE)):
            gel_advance_filtered(env, part, gels)


GEL = Gel(size=(6e-3, 5e-3, 4e-3), material=GelMaterial(poisson_ratio=0.48))
DT, DAMPING = 0.3, 0.2


def launch(state: GelState, advance: int, dt: float = DT) -> np.ndarray:
    """One substep, or its forces alone; (environments, PARTS, numbers) that it noted."""
    start_taichi()
    environments = len(state.groups[0].u)
    numbers = np.zeros((environments, PARAMS), np.float32)
    values = {STEP: dt, OWN_WEIGHT: 0.5, FILTERED_WEIGHT: 1.0}
    for g, params in enumerate(state.gels):
        values |= params.params(g) | {GEL_DAMPING + g: DAMPING}
    for index, value in values.items():
        numbers[:, index] = value
    counts = np.zeros((environments, COUNTS), np.int32)
    state.write_layout(counts)
    partial = np.full((environments, PARTS, NUMBERS), 1e9, np.float32)
    state.copy_surface()
    substep(len(state.gels), int(advance), *state.arguments(), numbers, counts, partial)
    return partial


def run(displacement: np.ndarray, dt: float = DT) -> tuple[np.ndarray, float]:
    """Forces of a gel with the given nodal displacement [mm], and the smallest det F that its parts saw."""
    state = GelState([gel_params(GEL, 1e-3)], 1)
    state.common_group.u[0, 0] = displacement
    partial = launch(state, FORCES, dt=dt)
    return state.common_group.f[0, 0], float(partial[0, :, SMALLEST_VOLUME].min())


def nodes() -> np.ndarray:
    params = gel_params(GEL, 1e-3)
    return np.stack(np.meshgrid(*[np.arange(n + 1.0) for n in params.elements], indexing="ij"), -1) * params.spacing


@pytest.mark.slow
def test_random_displacement_matches_the_reference() -> None:
    params = gel_params(GEL, 1e-3)
    u = np.random.default_rng(0).normal(scale=0.05, size=nodes().shape)
    f, _ = run(u)
    truth = laws.gel_forces(u, params.spacing, params.mu, params.lam, HOURGLASS_STIFFNESS)
    assert np.abs(f - truth).max() < 3e-6 * np.abs(truth).max()


def corner_energy(u: np.ndarray, h: float, modulus: float) -> float:
    """Of the corners narrower than MIN_CORNER_RATIO, each of an eighth of its element."""
    x, energy = nodes() + u, 0.0
    for i, j, k in np.ndindex(2, 2, 2):
        here, edges = x[i : x.shape[0] - 1 + i, j : x.shape[1] - 1 + j, k : x.shape[2] - 1 + k], []
        for axis, side in enumerate((i, j, k)):
            at = [slice(c, n - 1 + c) for c, n in zip((i, j, k), x.shape[:3], strict=True)]
            at[axis] = slice(1 - side, x.shape[axis] - side)
            edges.append((x[tuple(at)] - here) * (1 - 2 * side) / h)
        volume = np.linalg.det(np.stack(edges, axis=-1))
        energy += float((np.maximum(MIN_CORNER_RATIO - volume, 0.0) ** 2).sum()) * modulus / 2 * h**3 / 8
    return energy


@pytest.mark.slow
def test_narrow_corners_press_back_by_a_potential() -> None:
    """So their forces add up to none, and do not turn the gel; the other forces are as ever. With a long step they are
    less, and still add up to none."""
    params = gel_params(GEL, 1e-3)
    rng = np.random.default_rng(5)
    u = rng.normal(scale=0.22, size=nodes().shape)
    f, _ = run(u, 0.05)
    found = f - laws.gel_forces(u, params.spacing, params.mu, params.lam, HOURGLASS_STIFFNESS)
    modulus = CORNER_STIFFNESS * (params.lam + 2 * params.mu)
    largest = np.abs(found).max()
    assert largest > 0.01 * modulus
    for index in [tuple(rng.integers(0, u.shape)) for _ in range(40)]:
        step = np.zeros_like(u)
        step[index] = 1e-5
        slope = corner_energy(u + step, params.spacing, modulus) - corner_energy(u - step, params.spacing, modulus)
        assert found[index] == pytest.approx(-slope / 2e-5, abs=2e-4 * largest)
    softer = run(u, 0.5)[0] - f + found
    assert np.abs(softer).max() < 0.9 * largest
    for forces in (found, softer):
        assert np.abs(forces.sum(axis=(0, 1, 2))).max() < 1e-4 * largest
        assert np.abs(np.cross(nodes() + u, forces).sum(axis=(0, 1, 2))).max() < 1e-3 * largest


@pytest.mark.slow
@pytest.mark.parametrize("element", [1e-3, 0.5e-3])
def test_each_gel_of_each_environment_has_its_own_forces(element: float) -> None:
    """However many parts share a gel, and wherever its nodes begin in memory."""
    params = gel_params(GEL, element)
    state = GelState([params] * 2, 2)
    state.common_group.u[:] = u = np.random.default_rng(1).normal(
        scale=0.05 * params.spacing, size=state.common_group.u.shape
    )
    launch(state, FORCES)
    for environment, gel in np.ndindex(2, 2):
        truth = laws.gel_forces(u[environment, gel], params.spacing, params.mu, params.lam, HOURGLASS_STIFFNESS)
        assert np.abs(state.common_group.f[environment, gel] - truth).max() < 3e-6 * np.abs(truth).max()


@pytest.mark.slow
def test_gels_that_are_cut_differently_have_their_own_forces() -> None:
    """Of three environments: each gel at its place in memory, with its own spacing and material."""
    fine = Gel(size=(3.5e-3, 2e-3, 1.5e-3), material=GelMaterial(youngs_modulus=0.5e6, poisson_ratio=0.3))
    gels = [gel_params(GEL, 1e-3), gel_params(fine, 0.5e-3)]
    for order in (gels, gels[::-1]):
        state, rng = GelState(order, 3), np.random.default_rng(4)
        for params, group in zip(order, state.groups, strict=True):
            group.u[:] = rng.normal(scale=0.05 * params.spacing, size=group.u.shape)
        launch(state, FORCES)
        for params, group in zip(order, state.groups, strict=True):
            for environment in range(3):
                u = group.u[environment, 0].astype(np.float64)
                truth = laws.gel_forces(u, params.spacing, params.mu, params.lam, HOURGLASS_STIFFNESS)
                assert np.abs(group.f[environment, 0] - truth).max() < 3e-6 * np.abs(truth).max()


def test_a_substep_is_symplectic_euler_with_lumped_masses() -> None:
    """v <- (1 - alpha dt) v + dt (f + contact_force) / m, u <- u + dt v, held at the backing; the surface follows."""
    params = gel_params(GEL, 1e-3)
    state = GelState([params] * 2, 1)
    rng = np.random.default_rng(2)
    count = np.prod(state.common_group.u.shape[2:4])
    state.common_group.u[..., 1:, :] = u = rng.normal(scale=0.05, size=state.common_group.u[..., 1:, :].shape)
    state.common_group.v[..., 1:, :] = v = rng.normal(scale=0.01, size=u.shape)
    pushed = state.common_group.contact_force[..., :count, :3]
    pushed[...] = rng.normal(scale=0.01, size=pushed.shape)
    contact_force = state.common_group.contact_force.copy()
    partial = launch(state, PLAIN)
    assert not state.common_group.contact_force.any()  # zero for the next substep
    share = np.full(state.common_group.u.shape[2:5], 1.0)
    share[[0, -1]] *= 0.5
    share[:, [0, -1]] *= 0.5
    share[:, :, [0, -1]] *= 0.5
    mass = params.density * params.spacing**3 * share[..., 1:, None]
    for gel in range(2):
        whole = np.concatenate([np.zeros_like(u[0, gel, :, :, :1]), u[0, gel]], axis=2)
        force = laws.gel_forces(whole, params.spacing, params.mu, params.lam, HOURGLASS_STIFFNESS)
        held = partial[0].reshape(2, -1, NUMBERS)[gel, :, BACKING : BACKING + 3].sum(axis=0)
        assert held == pytest.approx(force[:, :, 0].sum(axis=(0, 1)), abs=1e-5 * np.abs(force).max())
        contact = (
            contact_force[0, gel, :, :count, :3].sum(axis=0, dtype=float).reshape(*state.common_group.u.shape[2:4], 3)
        )
        force[:, :, -1] += contact
        velocity = (1 - DAMPING * DT) * v[0, gel] + DT * force[:, :, 1:] / mass
        assert np.abs(state.common_group.v[0, gel, :, :, 1:] - velocity).max() < 1e-5 * np.abs(velocity).max()
        assert np.abs(state.common_group.u[0, gel, :, :, 1:] - u[0, gel] - DT * velocity).max() < 1e-5 * np.abs(u).max()
    assert not state.common_group.u[..., 0, :].any()
    surface = state.common_group.surface.copy()
    state.copy_surface()
    assert np.array_equal(surface[..., :3], state.common_group.surface[..., :3])


def test_rigid_motion_gives_no_force() -> None:
    turn = Rotation.from_rotvec([0.3, -0.5, 0.7]).as_matrix()
    f, smallest = run(nodes() @ turn.T - nodes() + [1.0, 2.0, 3.0])
    assert np.abs(f).max() < 2e-6
    assert smallest == pytest.approx(1.0, abs=1e-5)


def stress(deformation: np.ndarray) -> np.ndarray:
    """(3, 3) first Piola-Kirchhoff stress [MPa] of a gel deformed alike everywhere: the virial of its nodal forces."""
    f, _ = run(nodes() @ (deformation - np.eye(3)).T)
    return -np.einsum("abci,abcj->ij", f.astype(np.float64), nodes()) / np.prod(np.array(GEL.size) * 1e3)


def random_deformation(seed: int, size: float) -> np.ndarray:
    """(3, 3) with principal stretches of exp(-size) to exp(size), and any axes."""
    rng = np.random.default_rng(seed)
    first, second = Rotation.random(2, rng=rng).as_matrix()
    return first @ np.diag(np.exp(rng.uniform(-size, size, 3))) @ second


def pure_stretch(seed: int, size: float) -> np.ndarray:
    """(3, 3) symmetric; whatever lies between two of them has a positive volume."""
    axes = Rotation.random(rng=seed).as_matrix()
    return axes @ np.diag(np.exp(np.random.default_rng(seed).uniform(-size, size, 3))) @ axes.T


SEEDS, SIZES = st.integers(0, 10_000), st.floats(0.01, 0.4)


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS, size=SIZES)
def test_the_law_is_objective_isotropic_and_balances_moments(seed: int, size: float) -> None:
    f = random_deformation(seed, size)
    turn = Rotation.random(rng=seed).as_matrix()
    p = stress(f)
    scale = np.abs(p).max() + 1e-3 * gel_params(GEL, 1e-3).density
    assert np.abs(stress(turn @ f) - turn @ p).max() < 1e-4 * scale
    assert np.abs(stress(f @ turn) - p @ turn).max() < 1e-4 * scale
    assert np.abs(p @ f.T - f @ p.T).max() < 1e-4 * scale


@settings(max_examples=10, deadline=None)
@given(seed=SEEDS, size=SIZES)
def test_work_equals_change_of_stored_energy_on_any_path(seed: int, size: float) -> None:
    """W = mu/2 (|F|^2 - 3 - 2 ln J) + lambda/2 ln^2 J, straight and by a detour, each leg by Gauss-Legendre."""
    params = gel_params(GEL, 1e-3)
    rest, end, detour = np.eye(3), *(pure_stretch(seed + other, size) for other in (0, 1))
    log_j = np.log(np.linalg.det(end))
    energy = params.mu / 2 * (np.sum(end**2) - 3 - 2 * log_j) + params.lam / 2 * log_j**2
    places, weights = np.polynomial.legendre.leggauss(6)

    def work(a: np.ndarray, b: np.ndarray) -> float:
        powers = [np.sum(stress(a + (1 + place) / 2 * (b - a)) * (b - a)) for place in places]
        return float(weights @ powers) / 2

    assert work(rest, end) == pytest.approx(energy, rel=1e-3, abs=1e-5)
    assert work(rest, detour) + work(detour, end) == pytest.approx(energy, rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("stretch", [0.5, 0.9, 1.1])
def test_confined_compression(stretch: float) -> None:
    """Oedometer: P = mu (s - 1/s) + lambda ln(s) / s."""
    params = gel_params(GEL, 1e-3)
    u = nodes() * [0, 0, stretch - 1]
    f, _ = run(u)
    area = params.elements[0] * params.elements[1] * params.spacing**2
    stress = params.mu * (stretch - 1 / stretch) + params.lam * np.log(stretch) / stretch
    assert -f[:, :, -1, 2].sum() == pytest.approx(stress * area, rel=1e-5)
    assert f[:, :, 0, 2].sum() == pytest.approx(stress * area, rel=1e-5)


WAVES = np.array([[0.4, 0.3, -0.35], [-0.3, 0.45, 0.25], [0.35, -0.25, 0.4]])  # [1/mm], of u_x, u_y, u_z
PHASES, HEIGHT = np.array([0.3, 1.1, -0.7]), 0.25  # [mm]


def waves(x: np.ndarray) -> np.ndarray:
    return HEIGHT * np.sin(x @ WAVES.T + PHASES)


def divergence_of_stress(x: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """Div P at x (..., 3), where the gel is displaced by `waves`; by differences of fourth order of the exact P."""

    def stress(x: np.ndarray) -> np.ndarray:
        slope = HEIGHT * np.cos(x @ WAVES.T + PHASES)
        return laws.neo_hookean(np.eye(3) + slope[..., None] * WAVES, mu, lam)

    step, total = 1e-3, np.zeros_like(x)
    for axis, way in enumerate(step * np.eye(3)):
        near, far = stress(x + way) - stress(x - way), stress(x + 2 * way) - stress(x - 2 * way)
        total += ((8 * near - far) / (12 * step))[..., axis]
    return total


@pytest.mark.parametrize("nu", [0.0, 0.48])
def test_forces_in_a_smooth_field_converge_at_second_order(nu: float) -> None:
    """Nodal force over nodal volume is the divergence of the first Piola stress, at finite strain; hourglass stiffness
    vanishes at the same order: it weighs most where the Poisson ratio is 0."""
    gel, errors = Gel(size=(8e-3, 8e-3, 6e-3), material=GelMaterial(poisson_ratio=nu)), []
    for element in (1e-3, 0.5e-3, 0.25e-3):
        params = gel_params(gel, element)
        x = np.stack(np.meshgrid(*[np.arange(n + 1.0) for n in params.elements], indexing="ij"), -1) * params.spacing
        state = GelState([params], 1)
        state.common_group.u[0, 0] = waves(x)
        launch(state, FORCES)
        every = round(1e-3 / element)  # the nodes that all three have
        inside = (slice(every, -every, every),) * 3
        truth = divergence_of_stress(x[inside], params.mu, params.lam)
        error = state.common_group.f[0, 0][inside] / params.spacing**3 - truth
        errors.append(np.sqrt((error**2).mean() / (truth**2).mean()))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert orders == pytest.approx(2.0, abs=0.1)
    assert errors[-1] < 0.01


def test_hourglass_modes_are_resisted_and_linear_fields_are_not() -> None:
    i, j, k = np.indices(nodes().shape[:3])
    pattern = 0.01 * (-1.0) ** (i + j + k)
    f, _ = run(np.stack([pattern, 0 * pattern, 0 * pattern], -1))
    assert (f[..., 0] * pattern).sum() < -1e-4  # work against the checkerboard


def test_inverted_element_is_detected() -> None:
    u = np.zeros(nodes().shape)
    u[3:5, 3:5, 4, 2] = -1.2  # the top of one cell pushed through its bottom
    _, smallest = run(u)
    assert smallest < 0.05


def test_sizes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="does not divide"):
        gel_params(Gel(size=(20e-3, 20.4e-3, 4e-3)), 1e-3)


def test_a_gel_of_one_element_is_refused() -> None:
    with pytest.raises(ValueError, match=r"gives 1 x 4 x 4 elements of 1 mm; .* element_size of at most 0\.5 mm"):
        gel_params(Gel(size=(1e-3, 4e-3, 4e-3)), 1e-3)
    assert gel_params(Gel(size=(1e-3, 4e-3, 4e-3)), 0.5e-3).elements == (2, 8, 8)


def means_over_elements(a: np.ndarray) -> np.ndarray:
    """Of accelerations (nx + 1, ny + 1, nz + 1, 3): each element has the mean of its nodes, each node that of its
    elements; the backing, k = 0, does not move."""
    a = a.copy()
    a[:, :, 0] = 0.0
    corners = [tuple(slice(c, n - 1 + c) for c, n in zip(abc, a.shape, strict=False)) for abc in np.ndindex(2, 2, 2)]
    element = sum(a[at] for at in corners) / 8
    total, count = np.zeros_like(a), np.zeros(a.shape[:3])
    for at in corners:
        total[at] += element
        count[at] += 1
    total /= count[..., None]
    total[:, :, 0] = 0.0
    return total


def test_accelerations_are_filtered_by_means_over_elements() -> None:
    """Against the filter written out: accelerations a become a / 2 + (4 S - 1)^2 a. Its matrix is symmetric in the
    masses, and positive."""
    params, rng = gel_params(GEL, 1e-3), np.random.default_rng(5)
    state = GelState([params], 1)
    state.common_group.u[0, 0] = 0.02 * rng.standard_normal(state.common_group.u[0, 0].shape)
    state.common_group.u[0, 0, :, :, 0] = 0.0
    launch(state, SELECTIVE)
    share = np.ones(state.common_group.u.shape[2:5])
    for axis in range(3):
        ends = np.moveaxis(share, axis, 0)
        ends[[0, -1]] *= 0.5
    mass = params.density * params.spacing**3 * share[..., None]
    own = state.common_group.f[0, 0] / mass
    own[:, :, 0] = 0.0
    once = 4 * means_over_elements(own) - own
    truth = 0.5 * own + 4 * means_over_elements(once) - once
    error = state.common_group.v[0, 0] / DT - truth
    assert np.abs(error).max() < 2e-5 * np.abs(truth).max()
    a, b = (rng.standard_normal(own.shape) for _ in range(2))
    a[:, :, 0] = b[:, :, 0] = 0.0
    assert (mass * a * means_over_elements(b)).sum() == pytest.approx((mass * b * means_over_elements(a)).sum())
    assert 0.0 < (mass * a * means_over_elements(a)).sum() < (mass * a * a).sum()

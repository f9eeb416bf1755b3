"""Gel elements against the float64 reference and closed forms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tacsim.physics import reference
from tacsim.physics.element import HOURGLASS
from tacsim.physics.gel import (
    Corners,
    GelState,
    Lattice,
    NodeLanes,
    Nodes,
    Skin,
    Touch,
    gel_advance,
    gel_facts,
    gel_forces,
)
from tacsim.physics.lanes import PARTS, Counts, Facts, Partial
from tacsim.physics.layout import BACKING, COUNTS, FACTS, GEL_DAMPING, NUMBERS, SMALLEST_VOLUME, STEP
from tacsim.runtime import start, ti
from tacsim.scene import Gel, GelMaterial

pytestmark = pytest.mark.cpu


@ti.kernel
def substep(
    gels: ti.i32, advance: ti.i32,
    nodes: Nodes, n0: NodeLanes, nj: NodeLanes, ni: NodeLanes, nij: NodeLanes, skin: Skin, touch: Touch,
    c0: Corners, cj: Corners, ci: Corners, cij: Corners, lattice: Lattice,
    facts: Facts, counts: Counts, partial: Partial,
):  # fmt: skip
    ti.loop_config(serialize=True)
    for env in range(nodes.shape[0]):
        layers, nx, ny = nodes.shape[4] - 1, skin.shape[3] - 3, skin.shape[4] - 3
        for part in range(PARTS):
            gel_forces(
                env, part, gels, n0, nj, ni, nij, c0, cj, ci, cij, lattice, facts, counts, partial, layers, nx, ny
            )
        for part in range(PARTS * advance):
            gel_advance(env, part, gels, nodes, n0, skin, touch, lattice, facts, counts, partial, layers, nx, ny)


GEL = Gel(size=(6e-3, 5e-3, 4e-3), material=GelMaterial(poisson_ratio=0.48))
DT, DAMPING = 0.3, 0.2


def launch(state: GelState, advance: bool, element: float = 1e-3) -> np.ndarray:
    """One substep, or its forces alone; (environments, PARTS, numbers) that it noted."""
    start()
    facts = gel_facts(GEL, element)
    environments, gels = state.u.shape[:2]
    numbers = np.zeros((environments, FACTS), np.float32)
    for index, value in {**facts.facts(), STEP: DT, GEL_DAMPING: DAMPING}.items():
        numbers[:, index] = value
    counts = np.zeros((environments, COUNTS), np.int32)
    partial = np.full((environments, PARTS, NUMBERS), 1e9, np.float32)
    state.refresh()
    substep(gels, int(advance), *state.arguments(), numbers, counts, partial)
    return partial


def run(displacement: np.ndarray) -> tuple[np.ndarray, float]:
    """Forces of a gel with the given nodal displacement [mm], and the smallest det F that its parts saw."""
    state = GelState(gel_facts(GEL, 1e-3), 1, 1)
    state.u[0, 0] = displacement
    partial = launch(state, advance=False)
    return state.f[0, 0], float(partial[0, :, SMALLEST_VOLUME].min())


def nodes() -> np.ndarray:
    facts = gel_facts(GEL, 1e-3)
    return np.stack(np.meshgrid(*[np.arange(n + 1.0) for n in facts.elements], indexing="ij"), -1) * facts.spacing


def test_random_displacement_matches_the_reference() -> None:
    facts = gel_facts(GEL, 1e-3)
    u = np.random.default_rng(0).normal(scale=0.05, size=nodes().shape)
    f, _ = run(u)
    truth = reference.gel_forces(u, facts.spacing, facts.mu, facts.lam, HOURGLASS)
    assert np.abs(f - truth).max() < 3e-6 * np.abs(truth).max()


@pytest.mark.parametrize("element", [1e-3, 0.5e-3])
def test_each_gel_of_each_environment_has_its_own_forces(element: float) -> None:
    """However many parts share a gel, and wherever its nodes begin in memory."""
    facts = gel_facts(GEL, element)
    state = GelState(facts, 2, 2)
    state.u[:] = u = np.random.default_rng(1).normal(scale=0.05 * facts.spacing, size=state.u.shape)
    launch(state, False, element)
    for environment, gel in np.ndindex(2, 2):
        truth = reference.gel_forces(u[environment, gel], facts.spacing, facts.mu, facts.lam, HOURGLASS)
        assert np.abs(state.f[environment, gel] - truth).max() < 3e-6 * np.abs(truth).max()


def test_a_substep_is_symplectic_euler_with_lumped_masses() -> None:
    """v <- (1 - alpha dt) v + dt (f + touch) / m, u <- u + dt v, held at the backing; the skin follows the surface."""
    facts = gel_facts(GEL, 1e-3)
    state = GelState(facts, 1, 2)
    rng = np.random.default_rng(2)
    count = np.prod(state.u.shape[2:4])
    state.u[..., 1:, :] = u = rng.normal(scale=0.05, size=state.u[..., 1:, :].shape)
    state.v[..., 1:, :] = v = rng.normal(scale=0.01, size=u.shape)
    state.touch[..., :count, :3] = rng.normal(scale=0.01, size=state.touch[..., :count, :3].shape)
    partial = launch(state, advance=True)
    share = np.full(state.u.shape[2:5], 1.0)
    share[[0, -1]] *= 0.5
    share[:, [0, -1]] *= 0.5
    share[:, :, [0, -1]] *= 0.5
    mass = facts.density * facts.spacing**3 * share[..., 1:, None]
    for gel in range(2):
        whole = np.concatenate([np.zeros_like(u[0, gel, :, :, :1]), u[0, gel]], axis=2)
        force = reference.gel_forces(whole, facts.spacing, facts.mu, facts.lam, HOURGLASS)
        held = partial[0].reshape(2, -1, NUMBERS)[gel, :, BACKING : BACKING + 3].sum(axis=0)
        assert held == pytest.approx(force[:, :, 0].sum(axis=(0, 1)), abs=1e-5 * np.abs(force).max())
        contact = state.touch[0, :, gel, :count, :3].sum(axis=0, dtype=float).reshape(*state.u.shape[2:4], 3)
        force[:, :, -1] += contact
        velocity = (1 - DAMPING * DT) * v[0, gel] + DT * force[:, :, 1:] / mass
        assert np.abs(state.v[0, gel, :, :, 1:] - velocity).max() < 1e-5 * np.abs(velocity).max()
        assert np.abs(state.u[0, gel, :, :, 1:] - u[0, gel] - DT * velocity).max() < 1e-5 * np.abs(u).max()
    assert not state.u[..., 0, :].any()
    skin = state.skin.copy()
    state.refresh()
    assert np.array_equal(skin[..., :3], state.skin[..., :3])


def test_rigid_motion_gives_no_force() -> None:
    turn = Rotation.from_rotvec([0.3, -0.5, 0.7]).as_matrix()
    f, smallest = run(nodes() @ turn.T - nodes() + [1.0, 2.0, 3.0])
    assert np.abs(f).max() < 2e-6
    assert smallest == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("stretch", [0.5, 0.9, 1.1])
def test_confined_compression(stretch: float) -> None:
    """Oedometer: P = mu (s - 1/s) + lambda ln(s) / s."""
    facts = gel_facts(GEL, 1e-3)
    u = nodes() * [0, 0, stretch - 1]
    f, _ = run(u)
    area = facts.elements[0] * facts.elements[1] * facts.spacing**2
    stress = facts.mu * (stretch - 1 / stretch) + facts.lam * np.log(stretch) / stretch
    assert -f[:, :, -1, 2].sum() == pytest.approx(stress * area, rel=1e-5)
    assert f[:, :, 0, 2].sum() == pytest.approx(stress * area, rel=1e-5)


def test_hourglass_modes_are_resisted_and_linear_fields_are_not() -> None:
    i, j, k = np.indices(nodes().shape[:3])
    pattern = 0.01 * (-1.0) ** (i + j + k)
    f, _ = run(np.stack([pattern, 0 * pattern, 0 * pattern], -1))
    assert (f[..., 0] * pattern).sum() < -1e-4  # work against the checkerboard


def test_inversion_is_seen() -> None:
    u = np.zeros(nodes().shape)
    u[3:5, 3:5, 4, 2] = -1.2  # the top of one cell pushed through its bottom
    _, smallest = run(u)
    assert smallest < 0.05


def test_sizes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="does not divide"):
        gel_facts(Gel(size=(20e-3, 20.4e-3, 4e-3)), 1e-3)

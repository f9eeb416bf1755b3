"""Gel elements against the float64 reference and closed forms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tacsim.physics import reference
from tacsim.physics.gel import HOURGLASS, Nodes, gel_facts, gel_forces, gel_state
from tacsim.runtime import start, ti
from tacsim.scene import Gel, GelMaterial


@ti.kernel
def forces(u: Nodes, f: Nodes, h: ti.f32, mu: ti.f32, lam: ti.f32, health: ti.types.ndarray(dtype=ti.f32, ndim=1)):
    ti.loop_config(serialize=True)
    for g in range(u.shape[0]):
        gel_forces(g, u, f, h, mu, lam, health)


GEL = Gel(size=(6e-3, 5e-3, 4e-3), material=GelMaterial(poisson_ratio=0.48))


def run(displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Forces of a gel with the given nodal displacement [mm], and what the health array saw."""
    start()
    facts = gel_facts(GEL, 1e-3)
    state = gel_state(facts, 1)
    state.u[0] = displacement
    health = np.full(8, 1e9, np.float32)
    forces(state.u, state.f, facts.spacing, facts.mu, facts.lam, health)
    return state.f[0], health


def nodes() -> np.ndarray:
    facts = gel_facts(GEL, 1e-3)
    return np.stack(np.meshgrid(*[np.arange(n + 1.0) for n in facts.elements], indexing="ij"), -1) * facts.spacing


def test_random_displacement_matches_the_reference() -> None:
    facts = gel_facts(GEL, 1e-3)
    u = np.random.default_rng(0).normal(scale=0.05, size=nodes().shape)
    f, _ = run(u)
    truth = reference.gel_forces(u, facts.spacing, facts.mu, facts.lam, HOURGLASS)
    assert np.abs(f - truth).max() < 3e-6 * np.abs(truth).max()


def test_rigid_motion_gives_no_force() -> None:
    turn = Rotation.from_rotvec([0.3, -0.5, 0.7]).as_matrix()
    f, health = run(nodes() @ turn.T - nodes() + [1.0, 2.0, 3.0])
    assert np.abs(f).max() < 2e-6
    assert health[0] == pytest.approx(1.0, abs=1e-5)


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
    _, health = run(u)
    assert health[0] < 0.05


def test_sizes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="does not divide"):
        gel_facts(Gel(size=(20e-3, 20.4e-3, 4e-3)), 1e-3)

"""The laws of the seed's scheme: the body's return mapping on F, and its neo-Hookean gel."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchmarks.truth import laws
from tacsim.compute.runtime import start_taichi, ti
from tacsim.models.material import BodyMaterial, GelMaterial
from tacsim.physics.seed import kernels
from tacsim.physics.seed.kernels import Matrices, Solid
from tacsim.physics.seed.world import solid_of_material

pytestmark = pytest.mark.cpu

CLAY = BodyMaterial(yield_stress=30e3)
HARDLY = BodyMaterial(yield_stress=1e7)  # far beyond any strain here
SEEDS, SIZES = st.integers(0, 10_000), st.floats(1e-3, 0.4)
LIMITS = st.one_of(st.floats(1e-3, 0.2), st.just(math.inf))
some = settings(max_examples=25, deadline=None)


@ti.kernel
def gel_stress(F: Matrices, tau: Matrices, gel: Solid):
    for p in range(F.shape[0]):
        tau[p] = kernels.neo_hookean(F[p], gel)


@ti.kernel
def map_back(F: Matrices, tau: Matrices, body: Solid):
    ti.loop_config(serialize=True)
    for p in range(F.shape[0]):
        elastic, stress = kernels.body_law(F[p], body)
        F[p] = elastic
        tau[p] = stress


def clay(limit: float) -> BodyMaterial:
    """That yields at this norm of the strain deviator; inf: never."""
    return BodyMaterial(yield_strain=limit) if math.isfinite(limit) else BodyMaterial()


def random_f(count: int, size: float, seed: int) -> np.ndarray:
    """F = U S V^T, principal stretches within exp(+-size)."""
    rng = np.random.default_rng(seed)
    u, v = (Rotation.random(count, rng=rng).as_matrix() for _ in range(2))
    return (u * np.exp(rng.uniform(-size, size, (count, 1, 3)))) @ v


def turn(seed: int) -> np.ndarray:
    return Rotation.random(rng=seed + 1).as_matrix()


def mapped(trial: np.ndarray, material: BodyMaterial) -> tuple[np.ndarray, np.ndarray]:
    """Elastic F and Kirchhoff stress [MPa]."""
    start_taichi()
    f, tau = trial.astype(np.float32), np.zeros(trial.shape, np.float32)
    map_back(f, tau, solid_of_material(material, 1.0))
    return f.astype(float), tau.astype(float)


def pressed(f: np.ndarray) -> np.ndarray:
    """Stress of the gel [MPa]."""
    start_taichi()
    tau = np.zeros(f.shape, np.float32)
    gel_stress(f.astype(np.float32), tau, solid_of_material(GelMaterial(), 1.0))
    return tau.astype(float)


def deviator(m: np.ndarray) -> np.ndarray:
    return m - np.trace(m, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)


def strain(f: np.ndarray) -> np.ndarray:
    """Hencky strain 1/2 log F F^T."""
    values, axes = np.linalg.eigh(f @ f.swapaxes(1, 2))
    return np.einsum("nik,nk,njk->nij", axes, 0.5 * np.log(values), axes)


def size_of(tau: np.ndarray) -> float:
    """What errors are measured against [MPa]; float32 holds an F near 1 to 1e-7, so a stress no better than that."""
    return max(float(np.abs(tau).max()), 0.05)


def test_return_mapping_is_that_of_a_float64_svd() -> None:
    start_taichi()
    rng, n = np.random.default_rng(0), 2000
    u, v = (Rotation.random(n, random_state=seed_).as_matrix() for seed_ in (1, 2))
    trial = (u * np.exp(rng.normal(size=(n, 1, 3)) * rng.choice([1e-3, 0.02, 0.1, 0.4], (n, 1, 1)))) @ v
    law = solid_of_material(CLAY, 1.0)
    f, tau = trial.astype(np.float32), np.zeros((n, 3, 3), np.float32)
    map_back(f, tau, law)

    u, s, vt = np.linalg.svd(trial)
    e = np.log(s)
    mean = e.mean(axis=1, keepdims=True)
    dev = e - mean
    norm = np.linalg.norm(dev, axis=1, keepdims=True)
    returned = dev * np.minimum(1, CLAY.elastic_limit / norm)
    stress = 2 * law.mu * returned + (2 * law.mu + 3 * law.lam) * mean
    np.testing.assert_allclose(f, (u * np.exp(returned + mean)[:, None]) @ vt, atol=1e-5)
    np.testing.assert_allclose(tau, (u * stress[:, None]) @ u.swapaxes(1, 2), atol=1e-5)
    yields = norm[:, 0] > CLAY.elastic_limit
    assert 0.2 < yields.mean() < 0.8
    deviator = tau - np.trace(tau, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    np.testing.assert_allclose(
        np.linalg.norm(deviator[yields], axis=(1, 2)), 2 * law.mu * CLAY.elastic_limit, rtol=1e-3
    )
    np.testing.assert_allclose(f[~yields], trial[~yields], atol=1e-7)


@some
@given(seed=SEEDS, size=SIZES, limit=LIMITS)
def test_body_law_is_invariant_under_rotation(seed: int, size: float, limit: float) -> None:
    """Objective: F -> Q F turns the stress, and the elastic F with it."""
    f, q = random_f(20, size, seed), turn(seed)
    elastic, tau = mapped(f, clay(limit))
    elastic_turned, tau_turned = mapped(q @ f, clay(limit))
    assert np.abs(q @ tau @ q.T - tau_turned).max() < 8e-5 * size_of(tau)
    assert np.abs(q @ elastic - elastic_turned).max() < 1e-5


@some
@given(seed=SEEDS, size=SIZES, limit=LIMITS)
def test_the_body_has_no_grain(seed: int, size: float, limit: float) -> None:
    """Isotropic: F -> F R leaves the stress, whatever way the material lay before; and stress shares the axes of b."""
    f, r = random_f(20, size, seed), turn(seed)
    elastic, tau = mapped(f, clay(limit))
    elastic_turned, tau_turned = mapped(f @ r, clay(limit))
    assert np.abs(tau - tau_turned).max() < 8e-5 * size_of(tau)
    assert np.abs(elastic @ r - elastic_turned).max() < 1e-5
    b = f @ f.swapaxes(1, 2)
    assert np.abs(tau @ b - b @ tau).max() < 2e-6 * size_of(tau) * np.abs(b).max()


@some
@given(seed=SEEDS, size=SIZES, limit=st.floats(1e-3, 0.2))
def test_the_return_lands_on_the_yield_surface_keeps_volume_and_dissipates(
    seed: int, size: float, limit: float
) -> None:
    """|dev tau| = 2 mu limit where it yields; tau : d = |dev tau| times the flow, never negative."""
    f = random_f(20, size, seed)
    elastic, tau = mapped(f, clay(limit))
    mu = solid_of_material(CLAY, 1.0).mu
    before, norm = strain(f), np.linalg.norm(deviator(strain(f)), axis=(1, 2))
    resolution = 3e-6  # of float32, of a strain
    yields, rests = norm > limit + 2 * resolution, norm < limit - 2 * resolution
    held = np.linalg.norm(deviator(tau), axis=(1, 2)) / (2 * mu)
    assert held[yields] == pytest.approx(limit, abs=resolution, rel=1e-4)
    assert held[rests] == pytest.approx(norm[rests], abs=resolution, rel=1e-4)
    assert np.array_equal(elastic[rests], f.astype(np.float32)[rests])
    assert np.abs(np.linalg.det(elastic) / np.linalg.det(f) - 1).max() < 2e-5
    work = (tau * (before - strain(elastic))).sum(axis=(1, 2))
    exact = 2 * mu * limit * np.maximum(norm - limit, 0.0)
    assert np.abs(work - exact).max() < 1e-3 * exact.max() + resolution * size_of(tau)


def test_a_body_that_never_yields_runs_no_return_mapping() -> None:
    """Without singular values, whose logarithm has lost them, stresses of tiny strains keep their digits."""
    f = np.eye(3) + np.random.default_rng(0).uniform(-1e-5, 1e-5, (200, 3, 3))
    never, law = BodyMaterial(), solid_of_material(BodyMaterial(), 1.0)
    held = f.astype(np.float32).astype(float)
    e = strain(held)
    truth = 2 * law.mu * e + law.lam * np.trace(e, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    elastic, tau = mapped(f, never)
    assert np.array_equal(elastic, held)
    assert np.abs(tau - truth).max() < 2e-5 * np.abs(truth).max()
    _, by_return = mapped(f, HARDLY)
    assert np.abs(by_return - truth).max() > 1e-3 * np.abs(truth).max()


@pytest.mark.parametrize("size", [1e-3, 0.1, 0.2, 0.3, 1.0])
def test_unyielding_body_equals_body_below_its_yield_stress(size: float) -> None:
    f = random_f(500, size, 0)
    elastic, tau = mapped(f, BodyMaterial())
    same, truth = mapped(f, HARDLY)
    assert np.array_equal(elastic, same)
    assert np.abs(tau - truth).max() < 3e-5 * size_of(truth)


@some
@given(seed=SEEDS, size=SIZES)
def test_the_gel_is_neo_hookean_objective_and_isotropic(seed: int, size: float) -> None:
    """tau = P F^T with the first Piola-Kirchhoff stress of the other world's gel."""
    f, q, law = random_f(20, size, seed), turn(seed), solid_of_material(GelMaterial(), 1.0)
    tau = pressed(f)
    truth = laws.neo_hookean(f, law.mu, law.lam) @ f.swapaxes(1, 2)
    tolerance = 2e-5 * size_of(truth)
    assert np.abs(tau - truth).max() < tolerance
    assert np.abs(q @ tau @ q.T - pressed(q @ f)).max() < tolerance
    assert np.abs(tau - pressed(f @ q)).max() < tolerance


def test_the_gel_has_an_energy() -> None:
    """P = dW/dF of W = mu/2 (|F|^2 - 3) - mu ln J + lambda/2 (ln J)^2: work on a closed way comes back."""
    law, step = solid_of_material(GelMaterial(), 1.0), 1e-6
    f = random_f(20, 0.2, 1)
    ways = np.random.default_rng(2).normal(size=f.shape)

    def energy(f: np.ndarray) -> np.ndarray:
        log_j = np.log(np.linalg.det(f))
        return law.mu / 2 * ((f**2).sum(axis=(1, 2)) - 3) - law.mu * log_j + law.lam / 2 * log_j**2

    stress = pressed(f) @ np.linalg.inv(f).swapaxes(1, 2)
    slope = (energy(f + step * ways) - energy(f - step * ways)) / (2 * step)
    assert (stress * ways).sum(axis=(1, 2)) == pytest.approx(slope, abs=1e-4 * np.abs(slope).max())

"""Material laws of the kernels against the float64 reference."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchmarks.truth import laws
from tacsim.compute.runtime import start_taichi, ti
from tacsim.models.material import BodyMaterial, elastic_constants
from tacsim.physics.body import material
from tacsim.physics.body.plasticine import BodyParams, body_params

MU, BULK = 0.172, 1.67
Strains = ti.types.ndarray(dtype=material.vec6, ndim=1)
Scalars = ti.types.ndarray(dtype=ti.f32, ndim=1)
Matrices = ti.types.ndarray(dtype=material.mat3, ndim=1)
SEEDS, HARDENINGS = st.integers(0, 10_000), st.one_of(st.just(0.0), st.floats(0.0, 1.0))
some = settings(max_examples=25, deadline=None)


@ti.kernel
def return_all(e: Strains, flow: Scalars, tau: Strains, mu: ti.f32, bulk: ti.f32, limit: ti.f32, hardening: ti.f32):
    for p in range(e.shape[0]):
        elastic, new_flow, stress = material.hencky_return(e[p], flow[p], mu, bulk, limit, hardening)
        e[p] = elastic
        flow[p] = new_flow
        tau[p] = stress


@ti.kernel
def convect_all(e: Strains, d: Matrices):
    for p in range(e.shape[0]):
        e[p] = material.transport_strain(e[p], d[p])


@ti.kernel
def log_all(x: Scalars, y: Scalars):
    for p in range(x.shape[0]):
        y[p] = material.lanes_log(x[p])


def test_lanes_have_a_logarithm_to_float32s_digits():
    start_taichi()
    x = np.float32(np.concatenate([np.geomspace(0.05, 30.0, 20_000), 1.0 + np.linspace(-1e-3, 1e-3, 2_001)]))
    found, exact = np.zeros_like(x), np.log(x.astype(float))
    log_all(x, found)
    np.testing.assert_allclose(found, exact, rtol=2e-7)


def six(m: np.ndarray) -> np.ndarray:
    return np.stack([m[..., 0, 0], m[..., 1, 1], m[..., 2, 2], m[..., 0, 1], m[..., 0, 2], m[..., 1, 2]], -1)


def full(s: np.ndarray) -> np.ndarray:
    return np.stack(
        [s[..., 0], s[..., 3], s[..., 4], s[..., 3], s[..., 1], s[..., 5], s[..., 4], s[..., 5], s[..., 2]], -1
    ).reshape(*s.shape[:-1], 3, 3)


def random_b(count: int, size: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    strain = rng.uniform(-size, size, (count, 3))
    axes = Rotation.random(count, rng=seed).as_matrix()
    return np.einsum("nik,nk,njk->nij", axes, np.exp(2 * strain), axes)


def flows(count: int, seed: int) -> np.ndarray:
    """Equivalent plastic strains so far, in float32's numbers."""
    return np.random.default_rng(seed).uniform(0.0, 0.5, count).astype(np.float32).astype(float)


def returned(
    b: np.ndarray, flow: np.ndarray, limit: float, hardening: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Elastic b, equivalent plastic strain and stress after one return."""
    start_taichi()
    e = np.ascontiguousarray(six(b - np.eye(3)), np.float32)
    flow = np.array(flow, np.float32)
    tau = np.zeros_like(e)
    return_all(e, flow, tau, MU, BULK, limit, hardening)
    return full(e.astype(float)) + np.eye(3), flow.astype(float), full(tau.astype(float))


def drive(params: BodyParams, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stress (n, 3, 3) and equivalent plastic strain (n,) of one material point after each of the increments d of
    deformation (n, 3, 3)."""
    start_taichi()
    e, flow, tau = np.zeros((1, 6), np.float32), np.zeros(1, np.float32), np.zeros((1, 6), np.float32)
    stresses, flows = [], []
    for d in steps.astype(np.float32):
        convect_all(e, d[None])
        return_all(e, flow, tau, params.mu, params.bulk, params.limit, params.hardening)
        stresses.append(full(tau[0].astype(float)))
        flows.append(float(flow[0]))
    return np.array(stresses), np.array(flows)


@pytest.mark.parametrize(("size", "tolerance"), [(1e-3, 2e-6), (0.05, 2e-6), (0.2, 5e-6), (0.6, 2e-4)])
def test_elastic_stress_matches_the_reference(size: float, tolerance: float) -> None:
    b = random_b(500, size)
    _, _, tau = returned(b, np.zeros(len(b)), 1e9, 0.0)
    _, _, truth = laws.hencky_return(b, np.zeros(len(b)), MU, BULK, math.inf, 0.0)
    assert np.abs(tau - truth).max() < tolerance * np.abs(truth).max()


@some
@given(seed=SEEDS, size=st.floats(1e-3, 0.4), limit=st.floats(1e-3, 0.2), hardening=st.floats(0.0, 1.0))
def test_the_return_lands_on_the_yield_surface_and_keeps_volume(
    seed: int, size: float, limit: float, hardening: float
) -> None:
    """What yields ends at |dev tau| = 2 mu (limit + hardening flow), grown by its own flow; the rest is left alone."""
    b = random_b(20, size, seed)
    flow = flows(20, seed)
    b_new, flow_new, tau = returned(b, flow, limit, hardening)
    strain = np.linalg.norm(deviator(logarithm(b) / 2), axis=(1, 2))
    radius = limit + hardening * flow_new
    norm = np.linalg.norm(deviator(tau), axis=(1, 2))
    resolution = 3e-6 * (1 + size)  # float32, of a strain
    yields = strain > limit + hardening * flow + resolution
    assert norm[yields] / (2 * MU) == pytest.approx(radius[yields], rel=1e-4, abs=resolution)
    assert (flow_new[yields] >= flow.astype(np.float32)[yields]).all()
    rests = strain < limit + hardening * flow - resolution
    assert norm[rests] / (2 * MU) == pytest.approx(strain[rests], rel=1e-4, abs=resolution)
    assert np.array_equal(flow_new[rests], flow.astype(np.float32)[rests])
    assert np.abs(np.linalg.det(b_new) / np.linalg.det(b) - 1).max() < 3e-5


@some
@given(seed=SEEDS, size=st.floats(1e-3, 0.3), hardening=HARDENINGS)
def test_the_law_is_objective(seed: int, size: float, hardening: float) -> None:
    b, flow, turn = random_b(10, size, seed), flows(10, seed), Rotation.random(rng=seed + 1).as_matrix()
    b_new, flow_new, tau = returned(b, flow, 0.05, hardening)
    b_turned, flow_turned, tau_turned = returned(turn @ b @ turn.T, flow, 0.05, hardening)
    assert np.abs(turn @ tau @ turn.T - tau_turned).max() < 1e-5 * max(np.abs(tau).max(), 0.01)
    assert np.abs(turn @ b_new @ turn.T - b_turned).max() < 1e-5
    assert np.abs(flow_new - flow_turned).max() < 1e-5


@some
@given(seed=SEEDS, size=st.floats(1e-3, 0.3), limit=st.sampled_from([0.02, 0.1, 1e9]), hardening=HARDENINGS)
def test_the_law_is_isotropic(seed: int, size: float, limit: float, hardening: float) -> None:
    """Stress and elastic state share the axes of b: they commute with it, whatever the axes are."""
    b, flow = random_b(10, size, seed), flows(10, seed)
    b_new, _, tau = returned(b, flow, limit, hardening)
    for found in (tau, b_new):
        assert np.abs(found @ b - b @ found).max() < 1e-5 * np.abs(b - np.eye(3)).max() * max(np.abs(found).max(), 0.01)


@some
@given(seed=SEEDS, size=st.floats(1e-3, 0.4), limit=st.floats(1e-3, 0.2), hardening=HARDENINGS)
def test_plastic_flow_dissipates(seed: int, size: float, limit: float, hardening: float) -> None:
    """tau : d >= 0, d the plastic Hencky strain of the return: what the elastic strain lost, along its axes.

    Hardening keeps some of that work; what it does not keep, |d| times the first yield stress, is heat.
    """
    b, flow = random_b(20, size, seed), flows(20, seed)
    b_new, flow_new, tau = returned(b, flow, limit, hardening)
    lost = logarithm(b) / 2 - logarithm(b_new) / 2
    work = (tau * lost).sum(axis=(1, 2))
    norm = np.linalg.norm(deviator(logarithm(b) / 2), axis=(1, 2))
    resolution = 2e-6 * max(np.abs(tau).max(), 0.01)  # of float32
    assert work.min() > -resolution
    assert (flow_new >= flow).all()
    gamma = np.maximum(norm - (limit + hardening * flow), 0.0) / (1 + math.sqrt(2 / 3) * hardening)  # |d|
    grown = flow + math.sqrt(2 / 3) * gamma
    exact = 2 * MU * (limit + hardening * grown) * gamma  # |dev tau| |d|
    assert np.abs(work - exact).max() < 2e-3 * exact.max() + resolution
    heat = work - 2 * MU * hardening * flow_new * gamma
    assert np.abs(heat - 2 * MU * limit * gamma).max() < 2e-3 * exact.max() + resolution


def logarithm(b: np.ndarray) -> np.ndarray:
    values, axes = np.linalg.eigh(b)
    return np.einsum("nik,nk,njk->nij", axes, np.log(values), axes)


def deviator(m: np.ndarray) -> np.ndarray:
    return m - np.trace(m, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)


def test_convection_is_f_b_f_transposed() -> None:
    start_taichi()
    rng = np.random.default_rng(3)
    f = np.eye(3) + rng.uniform(-0.05, 0.05, (200, 3, 3))
    b = random_b(200, 0.1)
    assert np.abs(convected(b, f) - f @ b @ np.swapaxes(f, 1, 2)).max() < 1e-6


@some
@given(seed=SEEDS, size=st.floats(1e-3, 0.3), step=st.floats(1e-3, 0.1))
def test_transport_of_strain_is_invariant_under_rotation(seed: int, size: float, step: float) -> None:
    """Objective: after f <- q f, b turns by q, however far; and a step of mere rotation strains nothing."""
    start_taichi()
    rng, q = np.random.default_rng(seed), Rotation.random(rng=seed + 1).as_matrix()
    b, f = random_b(20, size, seed), np.eye(3) + rng.uniform(-step, step, (20, 3, 3))
    assert np.abs(convected(b, q @ f) - q @ convected(b, f) @ q.T).max() < 5e-6
    undeformed = np.tile(np.eye(3), (20, 1, 1))
    assert np.abs(convected(undeformed, np.tile(q, (20, 1, 1))) - undeformed).max() < 2e-6


def convected(b: np.ndarray, f: np.ndarray) -> np.ndarray:
    e = np.ascontiguousarray(six(b - np.eye(3)), np.float32)
    convect_all(e, np.ascontiguousarray(f - np.eye(3), np.float32))
    return full(e.astype(float)) + np.eye(3)


def test_tiny_strains_keep_their_digits() -> None:
    """Storing e = b - I: a strain of 1e-6 is still right to 1e-4, where b in float32 would have lost it all."""
    b = random_b(200, 1e-6)
    _, _, tau = returned(b, np.zeros(len(b)), 1e9, 0.0)
    e = b - np.eye(3)
    small = MU * (e - np.trace(e, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3))
    small += BULK / 2 * np.trace(e, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    assert np.abs(tau - small).max() < 1e-4 * np.abs(small).max()


def test_yield_norms() -> None:
    """A uniaxial yield stress reaches that plateau; the seed's Frobenius norm gives sqrt(3/2) of it."""
    uniaxial = BodyMaterial(yield_stress=30e3)
    frobenius = BodyMaterial(yield_stress=30e3, yield_norm="frobenius")
    assert frobenius.elastic_limit / uniaxial.elastic_limit == pytest.approx(math.sqrt(1.5))
    mu, _ = elastic_constants(uniaxial)
    deviator = 2 * mu * uniaxial.elastic_limit  # |dev tau|_F at yield = sqrt(2/3) sigma
    assert deviator * math.sqrt(1.5) == pytest.approx(30e3)


HARD = BodyMaterial(yield_stress=30e3, hardening_modulus=200e3)


@pytest.mark.parametrize(
    ("limit", "hardening"), [(1e-3, 0.0), (0.02, 0.0), (0.07, 0.0), (0.2, 0.0), (0.05, 0.05), (0.05, 1.0)]
)
def test_plastic_return_matches_the_reference(limit: float, hardening: float) -> None:
    b = random_b(500, 0.4)
    flow = np.random.default_rng(4).uniform(0.0, 0.5, 500)
    b_new, flow_new, tau = returned(b, flow, limit, hardening)
    b_truth, flow_truth, tau_truth = laws.hencky_return(b, flow, MU, BULK, limit, hardening)
    assert (flow_truth > flow).sum() > 100  # some yield
    if hardening == 1.0:
        assert (flow_truth == flow).sum() > 100  # and some have hardened enough not to
    assert np.abs(flow_new - flow_truth).max() < 3e-5
    assert np.abs(tau - tau_truth).max() < 3e-4 * np.abs(tau_truth).max()
    assert np.abs(b_new - b_truth).max() < 3e-4


def test_uniaxial_yield_stress_grows_with_the_plastic_strain() -> None:
    """Isochoric tension by eps, then back: sigma = sigma_y + H p, with p from 3 mu (eps - p) = sigma (Simo & Hughes
    1998, section 1.2); isotropic hardening resists the way back as much."""
    params = body_params(HARD, 1e-3)
    rate, count = 2e-3, 100
    there = np.diag([np.expm1(rate), np.expm1(-rate / 2), np.expm1(-rate / 2)])
    back = np.diag([np.expm1(-rate), np.expm1(rate / 2), np.expm1(rate / 2)])
    tau, flow = drive(params, np.array([there] * count + [back] * 2 * count))
    stress = tau[:, 0, 0] - tau[:, 1, 1]
    yield_stress, modulus = 30e-3, 200e-3  # [MPa]
    strain = rate * np.arange(1, count + 1)
    plastic = np.maximum(0.0, (3 * params.mu * strain - yield_stress) / (3 * params.mu + modulus))
    elastic = 3 * params.mu * strain <= yield_stress
    assert 5 < elastic.sum() < 50
    assert flow[:count] == pytest.approx(plastic, abs=1e-5)
    assert stress[:count] == pytest.approx(np.where(elastic, 3 * params.mu * strain, yield_stress + modulus * plastic),
                                           rel=1e-4)  # fmt: skip
    returning = stress[count:] < 0
    yielding = np.diff(flow, prepend=0.0)[count:] > 0
    assert yielding.sum() > 20
    assert (returning | ~yielding).all()
    grown = -(yield_stress + modulus * flow[count:])
    assert stress[count:][yielding] == pytest.approx(grown[yielding], rel=1e-4)
    assert (stress[count:] >= grown * (1 + 1e-4)).all()


def test_shear_stress_grows_with_the_plastic_strain() -> None:
    """Simple shear by g: sqrt 3 tau = sigma_y + H p with sqrt 3 p = g - tau / mu, for small elastic strain."""
    params = body_params(HARD, 1e-3)
    step, count = 1e-3, 200
    d = np.zeros((3, 3))
    d[0, 1] = step
    tau, flow = drive(params, np.array([d] * count))
    shear = step * count
    yield_stress, modulus = 30e-3, 200e-3  # [MPa]
    plastic = (math.sqrt(3) * shear * params.mu - yield_stress) / (3 * params.mu + modulus)
    norm = np.linalg.norm(deviator(tau), axis=(1, 2))
    # to the digit: the yield surface grows with the plastic strain, whatever else finite shear does
    yielding = np.diff(flow, prepend=0.0) > 0
    grown = math.sqrt(2 / 3) * (yield_stress + modulus * flow)
    assert norm[yielding] == pytest.approx(grown[yielding], rel=1e-4)
    assert flow[-1] == pytest.approx(plastic, rel=0.02)
    assert tau[-1, 0, 1] == pytest.approx((yield_stress + modulus * plastic) / math.sqrt(3), rel=0.02)


@pytest.mark.parametrize("norm", ["uniaxial", "frobenius"])
def test_the_hardening_modulus_is_that_of_the_uniaxial_yield_stress(norm: str) -> None:
    """2 mu (k + growth p) = |dev tau| = sqrt(2/3) (sigma_y + H p), however the first yield stress is meant."""
    params = body_params(HARD.model_copy(update={"yield_norm": norm}), 1e-3)
    assert 2 * params.mu * params.hardening == pytest.approx(math.sqrt(2 / 3) * 0.2)
    assert body_params(BodyMaterial(yield_stress=30e3), 1e-3).hardening == 0.0

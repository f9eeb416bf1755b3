"""What the body's transfers keep of a motion, and that what never yields is not looked at for yielding."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.truth.blocks import BodyBlock
from benchmarks.truth.clay import COURANT
from tacsim.geometry.sampling import body_points
from tacsim.models.material import BodyMaterial
from tacsim.models.scene import Body, Box
from tacsim.physics.body.material import UNREACHABLE_LIMIT
from tacsim.physics.body.plasticine import BodyParams, body_params
from tacsim.physics.body.tuning import STENCIL_REACH
from tacsim.physics.exec import layout
from tacsim.physics.exec.lanes import NODES

pytestmark = pytest.mark.cpu

BOX = Box(size=(4e-3, 3e-3, 5e-3))
ELASTIC_BODY = BodyMaterial()


def block(params: BodyParams, spacing: float, sampling: str = "lattice") -> BodyBlock:
    """A free body off the grid's own planes, its grid laid round it."""
    points = body_points(Body.model_validate({"geometry": BOX, "sampling": sampling}), spacing) * 1e3
    body = BodyBlock(params, points + [0.013, -0.007, 0.002], COURANT * params.cell)
    body.fit(2 * params.cell)
    return body


GRADIENT = np.array([[0.02, -0.05, 0.01], [0.03, -0.02, 0.04], [-0.06, 0.05, 0.01]])
CURVATURE = np.random.default_rng(0).uniform(-0.02, 0.02, (3, 3, 3))  # [component, x, y]


def transferred(spacing: float, curvature: np.ndarray, sampling: str = "lattice") -> tuple[float, float]:
    """Largest error of velocities and of their gradients after particles -> grid -> particles, of an unstressed body
    whose velocity is 0.01 + G x + x K x."""
    body = block(body_params(ELASTIC_BODY, spacing), spacing, sampling)
    x = body.state.x().astype(np.float64)
    velocity = 0.01 + x @ GRADIENT.T + np.einsum("dij,ni,nj->nd", curvature, x, x)
    gradient = GRADIENT + np.einsum("dij,nj->ndi", curvature, x) + np.einsum("dij,ni->ndj", curvature, x)
    body.state.v()[:], body.state.c()[:] = velocity, gradient
    body.advance(1)
    return np.abs(body.state.v() - velocity).max(), np.abs(body.state.c() - gradient).max()


@pytest.mark.parametrize("sampling", ["lattice", "random"])
def test_an_affine_motion_comes_back_as_it_went(sampling: str) -> None:
    """Jiang et al. 2015, section 5.3: APIC keeps affine velocities, at the border and between particles too."""
    velocity, gradient = transferred(0.5e-3, np.zeros((3, 3, 3)), sampling)
    assert velocity < 1e-6
    assert gradient < 1e-5


def test_what_bends_comes_back_to_second_order() -> None:
    """A quadratic field: velocities lose h^2, their gradients h, up to the border."""
    errors = np.array([transferred(h, CURVATURE) for h in (0.5e-3, 0.25e-3, 0.125e-3)])
    orders = np.log2(errors[:-1] / errors[1:])
    assert (orders[:, 0] > 1.9).all()
    assert (orders[:, 1] > 0.9).all()
    assert errors[0, 0] < np.abs(CURVATURE).max() * 3 * 1.0**2  # of cells of 1 mm


@pytest.mark.parametrize(("limit", "yields"), [(UNREACHABLE_LIMIT, False), (0.5 * UNREACHABLE_LIMIT, True)])
def test_a_body_that_never_yields_runs_no_return_mapping(limit: float, yields: bool) -> None:
    """Told by a flow that has softened the body to nothing, which the return mapping alone looks at."""
    params = body_params(ELASTIC_BODY, 0.5e-3)
    assert params.limit == UNREACHABLE_LIMIT
    hardening = 2.0**-10  # a power of two: what is left is 0 to the digit
    body = block(replace(params, limit=limit, hardening=hardening), 0.5e-3)
    body.state.plastic_strain()[:] = -limit / hardening
    body.state.c()[:], body.state.v()[:] = GRADIENT, body.state.x() @ GRADIENT.T
    shear = []
    for _ in range(3):
        body.advance(1)
        shear.append(float(np.abs(body.state.e()[:, 3:]).mean()))
    assert shear[0] > 5e-3
    if yields:  # what one substep adds, the return of the next takes away
        assert shear[2] == pytest.approx(shear[0], rel=0.1)
    else:
        assert shear[2] > 2 * shear[0]


def test_elastic_strain_is_that_of_the_deformation() -> None:
    """b_e = F F^T of what never yields, however it swings: strain is a function of where the grid's nodes are, so no
    cycle leaves any in it."""
    body = block(body_params(ELASTIC_BODY, 0.5e-3), 0.5e-3)
    x = body.state.x().astype(np.float64)
    body.state.v()[:] = 0.6 * (x @ GRADIENT.T + np.einsum("dij,ni,nj->nd", CURVATURE, x, x))
    body.advance(200)
    f = body.state.deformation().astype(np.float64)
    strain = (f @ f.swapaxes(1, 2) - np.eye(3))[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    assert np.abs(strain).max() > 0.02  # and rounding is a thousandth of it
    assert body.state.e() == pytest.approx(strain, abs=2e-5)


def test_a_new_reference_changes_neither_state_nor_motion() -> None:
    """Places, speeds, strains, the rate of strain in space and the angular momentum stay."""
    body = block(body_params(ELASTIC_BODY, 0.5e-3), 0.5e-3)
    body.state.v()[:] = body.state.x() @ GRADIENT.T
    body.advance(10)
    x, v, e = (a.copy() for a in (body.state.x(), body.state.v(), body.state.e()))
    f = body.state.deformation()
    straining, spinning = body.state.c() @ np.linalg.inv(f), body.state.c() @ f.swapaxes(1, 2)
    body.state.move_reference(0)
    assert np.array_equal(body.state.x(), x) and np.array_equal(body.state.v(), v) and np.array_equal(body.state.e(), e)
    assert np.array_equal(body.state.reference(), x) and not body.state.gradient().any()
    c = body.state.c()
    assert c + c.swapaxes(1, 2) == pytest.approx(straining + straining.swapaxes(1, 2), abs=1e-6)
    assert c - c.swapaxes(1, 2) == pytest.approx(spinning - spinning.swapaxes(1, 2), abs=1e-6)


@pytest.mark.parametrize("count", [1, 2, 18, 19, 20, 21])  # 19: stencils end just where the grid does
def test_the_grid_ends_where_nothing_has_mass(count: int) -> None:
    """The filter of the accelerations takes it that nodes at the border have none; parts write into their slabs."""
    params = body_params(ELASTIC_BODY, 0.5e-3)
    line = params.spacing * (np.arange(count) + 0.1)
    points = np.stack(np.meshgrid(line, line[:3], line, indexing="ij"), axis=-1).reshape(-1, 3)
    body = BodyBlock(params, points, COURANT * params.cell)
    body.fit(STENCIL_REACH * params.cell)
    body.advance(1)  # raises for what is outside a slab
    shape = tuple(body.counts[0, layout.GRID : layout.GRID + 3])
    mass = np.zeros(shape)
    for part, copy in enumerate(body.state.masses[0]):
        low, high = body.counts[0, layout.SLAB + 2 * part : layout.SLAB + 2 * part + 2]
        mass[low:high] += copy[: np.prod(shape) // NODES, 3::4].reshape(shape)[low:high]
    assert mass.sum() == pytest.approx(len(points) * params.particle_mass, rel=1e-5)
    assert mass[1:-1, 1:-1, 1:-1].sum() == mass.sum()
    assert mass[2:-2].sum(axis=(1, 2)).all()  # and no plane is there in vain but one that rounding may need


def test_what_is_known_of_the_places_on_the_grid_follows_them() -> None:
    """Whoever has moved one: a launch asks anew."""
    body = block(body_params(ELASTIC_BODY, 0.5e-3), 0.5e-3).state
    before = body.grid_layout(0)
    assert body.grid_layout(0) is before
    body.reference(0)[3] += [1.0, 0.0, -2.0]
    assert not np.array_equal(body.extents(0), before.extents)
    np.testing.assert_allclose(
        body.grid_layout(0).centre - before.centre, np.array([1.0, 0.0, -2.0]) / len(body.x(0)), atol=1e-6
    )

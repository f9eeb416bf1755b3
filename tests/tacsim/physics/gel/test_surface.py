"""Contact and renderer see one surface: tacsim/physics/contact/contact.py in Taichi, tacsim/optics/spline.py in
NumPy."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tacsim.compute.runtime import start_taichi, ti
from tacsim.models.scene import Gel
from tacsim.optics.spline import displacement_and_jacobian
from tacsim.physics.contact.contact import spline_stencil, surface_sums
from tacsim.physics.exec.environment import Floats
from tacsim.physics.exec.lanes import vec2, vec4
from tacsim.physics.gel.gel import GelState, gel_params, gel_surface
from tacsim.physics.gel.kernels import Gel as KernelGel
from tacsim.physics.units import MM

GEL = gel_params(Gel(size=(6e-3, 5e-3, 2e-3)), 0.5e-3)
NX, NY, _ = GEL.elements
SECOND = 1  # of two gels: its surface does not begin where `surface` does
SURFACE_SIZE = 2 * (NX + 3) * (NY + 3) * 4  # numbers
F32 = float(np.finfo(np.float32).eps)
Points = ti.types.ndarray(dtype=vec2, ndim=1)
Sums = ti.types.ndarray(dtype=vec4, ndim=2)


@ti.kernel
def evaluate(surface: Floats, points: Points, found: Sums, gel: ti.i32, h: ti.f32, nx: ti.i32, ny: ti.i32):
    """Displacement [mm] and its derivatives by x and y, as contact has them, at lattice coordinates."""
    start = gel * SURFACE_SIZE
    gels = ti.static(KernelGel(None, surface, None, None, None, gel, nx, ny, 0, start, 0, 0))
    for p in range(points.shape[0]):
        i, wx, dx = spline_stencil(points[p][0])
        j, wy, dy = spline_stencil(points[p][1])
        value, by_x, by_y = surface_sums(gels, 0, i, j, wx, wy, dx / h, dy / h)
        found[p, 0], found[p, 1], found[p, 2] = value, by_x, by_y


def rim(count: int) -> np.ndarray:
    """Lattice coordinates along all four edges, corners first."""
    along = np.linspace(0.0, 1.0, count)
    edges = [[(0.0, t), (1.0, t), (t, 0.0), (t, 1.0)] for t in along]
    return np.array(edges).reshape(-1, 2) * [NX, NY]


def normals(by_x: np.ndarray, by_y: np.ndarray) -> np.ndarray:
    across = np.cross([1.0, 0.0, 0.0] + by_x, [0.0, 1.0, 0.0] + by_y)
    return across / np.linalg.norm(across, axis=1, keepdims=True)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), size=st.floats(1e-3, 0.1))
@example(seed=0, size=0.1)
def test_contact_and_renderer_see_the_same_surface(seed: int, size: float) -> None:
    """Values, derivatives and normals within the rounding of float32, at nodes, between them and on the rim."""
    start_taichi()
    rng = np.random.default_rng(seed)
    state = GelState([GEL, GEL], 1)
    state.common_group.u[...] = rng.normal(scale=size, size=state.common_group.u.shape)
    state.copy_surface()
    nodes = np.stack(np.meshgrid(np.arange(NX + 1), np.arange(NY + 1)), -1).reshape(-1, 2)
    between = nodes[(nodes < [NX, NY]).all(axis=1)] + 0.5  # where the stencil changes
    points = np.concatenate([rng.uniform(0.0, (NX, NY), (300, 2)), rim(20), nodes, between]).astype(np.float32)
    found = np.zeros((len(points), 3, 4), np.float32)
    evaluate(state.common_group.surface.reshape(-1), points, found, SECOND, GEL.spacing, NX, NY)

    surface = gel_surface(GEL, state.common_group.u[0, SECOND, :, :, -1])
    drawn, jacobian = displacement_and_jacobian(surface, surface.origin + points.astype(np.float64) * surface.spacing)
    value, by_x, by_y = found[:, 0, :3].astype(np.float64), found[:, 1, :3], found[:, 2, :3]
    largest = float(np.abs(state.common_group.u).max())  # [mm]
    place = largest / GEL.spacing * F32 * max(NX, NY)  # what rounding of a coordinate can make of it
    assert value == pytest.approx(drawn * MM, abs=4 * F32 * largest + place * GEL.spacing)
    assert by_x == pytest.approx(jacobian[..., 0], abs=16 * F32 * largest / GEL.spacing + 2 * place)
    assert by_y == pytest.approx(jacobian[..., 1], abs=16 * F32 * largest / GEL.spacing + 2 * place)
    steep = normals(by_x, by_y)
    assert steep == pytest.approx(normals(jacobian[..., 0], jacobian[..., 1]), abs=1e-5)

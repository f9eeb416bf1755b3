"""The body's surface as its particles know it, and the print that it makes on a gel."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from benchmarks.truth.roughness import print_roughness
from tacsim.compute.runtime import start_taichi, ti
from tacsim.geometry.sampling import body_points
from tacsim.geometry.shapes import enclosed_volume, shape_distance
from tacsim.interface import Pose
from tacsim.models.material import BodyMaterial
from tacsim.models.scene import Body, Box, Mesh, Scene, Sphere
from tacsim.physics.body.surface import surface_points, tangent_planes
from tacsim.physics.body.transfers import transport_plane
from tacsim.physics.exec.lanes import vec3
from tacsim.physics.worlds.hybrid import HybridWorld
from tacsim.physics.worlds.tuning import INITIAL_GAP

MM = 1e-3
SPACING = 0.5 * MM
CLAY = BodyMaterial(yield_stress=30e3)
CUBE = Box(size=(10e-3, 10e-3, 6e-3))
BALL = Sphere(radius=8e-3)
UM = 1e-6


@pytest.mark.parametrize("geometry", [CUBE, BALL], ids=lambda g: g.shape)
@pytest.mark.parametrize("sampling", ["lattice", "random"])
def test_outer_particles_know_the_surface(geometry: Box | Sphere, sampling: str) -> None:
    points = body_points(Body.model_validate({"geometry": geometry, "sampling": sampling}), SPACING)
    planes = tangent_planes(geometry, points, SPACING)
    known = planes.any(axis=1)
    assert np.array_equal(known, shape_distance(geometry, points) > -SPACING * 1.0000001)
    feet = surface_points(points, planes)
    assert np.array_equal(feet[~known], points[~known])
    off = np.abs(shape_distance(geometry, feet[known]))
    if isinstance(geometry, Sphere):
        assert off.max() < 0.011 * SPACING  # particles on the surface itself stand in the least depth
    else:  # at an edge two faces are equally near, and the mean direction leads between them
        assert np.mean(off < 1e-9) > 0.75


def test_mesh_has_same_tangent_planes_as_its_shape(tmp_path: Path) -> None:
    trimesh.creation.box((10, 10, 6)).export(tmp_path / "box.stl")
    points = body_points(Body(geometry=CUBE, sampling="random"), SPACING)
    of_mesh = tangent_planes(Mesh(path=str(tmp_path / "box.stl")), points, SPACING)
    assert of_mesh == pytest.approx(tangent_planes(CUBE, points, SPACING), rel=1e-6, abs=1e-3)


Points = ti.types.ndarray(dtype=vec3, ndim=1)


@ti.kernel
def flow(n: ti.i32, planes: Points, columns: Points, dt: ti.f32):
    """columns: of C, its derivatives by x, y, z."""
    ti.loop_config(serialize=True)
    for _ in range(n):
        for p in range(planes.shape[0]):
            planes[p] = transport_plane(planes[p], dt * ti.Matrix.cols([columns[0], columns[1], columns[2]]))


def test_planes_go_with_the_material() -> None:
    """Feet moved by F must lie on the moved planes, m' = F^-T m, to rounding. What a substep turns too much adds up: a
    ball of clay rolled 200 times lost 7 % of its force by it."""
    start_taichi()
    rng = np.random.default_rng(0)
    rate = rng.normal(scale=0.3, size=(3, 3))
    steps = 50
    planes = rng.normal(size=(20, 3)).astype(np.float32)
    planes[7] = 0.0
    moved = planes.copy()
    flow(steps, moved, np.ascontiguousarray(rate.T, np.float32), 1.0 / steps)
    f = np.linalg.matrix_power(np.eye(3) + rate / steps, steps)
    assert moved == pytest.approx(planes @ np.linalg.inv(f), abs=2e-5)
    assert not moved[7].any()


def squeezed(geometry: Box | Sphere, sampling: str, by: float) -> HybridWorld:
    """Both sensors `by` nearer than at first touch."""
    scene = {"body": {"geometry": geometry, "material": CLAY, "sampling": sampling}, "settling": {"tolerance": 2e-2}}
    world = HybridWorld(Scene.model_validate(scene))
    targets = {}
    for name, sign in (("lower", 1.0), ("upper", -1.0)):
        pose = world.pose(name)
        targets[name] = Pose(pose.position + [0, 0, sign * (by / 2 + INITIAL_GAP)], pose.quaternion)
    world.move(targets)
    return world


@pytest.mark.parametrize(
    ("geometry", "sampling", "limit"),
    [(CUBE, "lattice", 5 * UM), (CUBE, "random", 10 * UM), (BALL, "lattice", 12 * UM)],
)
def test_the_print_does_not_show_the_particles(geometry: Box | Sphere, sampling: str, limit: float) -> None:
    """With one radius for all particles these print 3, 50 and 70 um. A ball's print is not flat itself: pressed at Mach
    0.005 to a tolerance of 5e-4 it has 9.4 to 10.6 um."""
    world = squeezed(geometry, sampling, 2e-3)
    for name in world.sensors:
        assert print_roughness(world.surface(name)) < limit


def test_random_and_lattice_bodies_press_alike_and_weigh_the_same() -> None:
    forces = []
    for sampling in ("lattice", "random"):
        world = squeezed(CUBE, sampling, 1e-3)
        forces.append(world.wrench("lower")[2])
        assert len(world.truth().points) * world._body.volume == pytest.approx(enclosed_volume(CUBE) * 1e9, rel=1e-9)
    assert forces[1] == pytest.approx(forces[0], rel=0.03)


def test_height_is_that_of_the_surface() -> None:
    for sampling in ("lattice", "random"):
        scene = {"body": {"geometry": BALL, "material": CLAY, "sampling": sampling}}
        assert HybridWorld(Scene.model_validate(scene)).truth().height == pytest.approx(16e-3, abs=0.1e-3)

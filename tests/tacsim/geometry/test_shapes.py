"""Particles, signed distance and distance grids against closed forms and brute force."""

from __future__ import annotations

import os
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tacsim.geometry import shapes
from tacsim.geometry.mesh_file import file_fingerprint, load_mesh
from tacsim.geometry.shapes import (
    bounding_size,
    edge_points,
    edge_radius,
    enclosed_volume,
    farthest_point,
    lattice_particles,
    shape_distance,
)
from tacsim.geometry.tiles import cached_tiled_distance
from tacsim.models.scene import Box, Cylinder, Indenter, Mesh, Shape, Sphere

MM = 1e-3
WEDGE = np.array([[0, 0, 0], [6, 0, 0], [0, 4, 0], [0, 0, 3.0]])  # a right-angled tetrahedron: no symmetry at all


def stl(folder: Path, mesh: trimesh.Trimesh, name: str = "part.stl") -> Mesh:
    """Writes `mesh` [mm] as a binary STL."""
    mesh.export(folder / name)
    return Mesh(path=str(folder / name))


def wedge() -> trimesh.Trimesh:
    return trimesh.Trimesh(WEDGE, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def ell() -> trimesh.Trimesh:
    """A prism over an L: has a concave edge, where signs taken from the nearest face alone go wrong."""
    outline = np.array([[0, 0], [5, 0], [5, 2], [2, 2], [2, 4], [0, 4.0]])
    caps = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    sides = [[i, (i + 1) % 6, i + 6] for i in range(6)] + [[(i + 1) % 6, (i + 1) % 6 + 6, i + 6] for i in range(6)]
    corners = np.vstack([np.column_stack([outline, np.full(6, z)]) for z in (0.0, 3.0)])
    return trimesh.Trimesh(corners, np.vstack([caps[:, ::-1], caps + 6, sides]))


def ell_distance(points: np.ndarray) -> np.ndarray:
    """Closed form of `ell` [mm], centred: union of two boxes outside; inside the complement's distance."""
    at = np.abs(points[:, 2]) - 1.5
    x, y = points[:, 0] + 2.5, points[:, 1] + 2.0
    outline = np.array([[0, 0], [5, 0], [5, 2], [2, 2], [2, 4], [0, 4.0], [0, 0]])
    flat = np.full(len(points), np.inf)
    for a, b in pairwise(outline):
        s = np.clip(((x - a[0]) * (b - a)[0] + (y - a[1]) * (b - a)[1]) / ((b - a) @ (b - a)), 0, 1)
        flat = np.minimum(flat, np.hypot(x - a[0] - s * (b - a)[0], y - a[1] - s * (b - a)[1]))
    inside = (x > 0) & (y > 0) & (((x < 5) & (y < 2)) | ((x < 2) & (y < 4)))
    flat = np.where(inside, -flat, flat)
    return np.hypot(np.maximum(flat, 0), np.maximum(at, 0)) + np.minimum(np.maximum(flat, at), 0)


# particles


def test_box_lattice_starts_half_a_spacing_inside_each_face() -> None:
    found = lattice_particles(Box(size=(3 * MM, 5 * MM, 2 * MM)), 0.5 * MM)
    assert found.shape == (6 * 10 * 4, 3)
    assert np.allclose(found.max(axis=0), [1.25 * MM, 2.25 * MM, 0.75 * MM])
    assert np.allclose(found.min(axis=0), -found.max(axis=0))
    assert len(np.unique(np.round(found[:, 2] / MM, 9))) == 4  # flat layers, no orange peel


def test_how_sharp_the_edges_of_an_indenter_are(tmp_path: Path) -> None:
    """A mesh's are sharp where it sticks out at more than 30 degrees; facets of a round one are no edges."""
    cube, ball = trimesh.creation.box((4, 4, 4)), trimesh.creation.icosphere(subdivisions=3, radius=4.0)
    for geometry, radius in (
        (Sphere(radius=4 * MM), np.inf),
        (Box(size=(4 * MM, 4 * MM, 4 * MM)), 0.5 * MM),
        (Cylinder(radius=2 * MM, height=1 * MM), 0.25 * MM),
        (stl(tmp_path, cube, "cube.stl"), 0.0),
        (stl(tmp_path, ball, "ball.stl"), np.inf),
    ):
        assert edge_radius(Indenter(geometry=geometry), 1 * MM) == radius
    assert edge_radius(Indenter(geometry=Box(size=(4 * MM, 4 * MM, 4 * MM)), edge_radius=0.1 * MM), 1 * MM) == 0.1 * MM


def test_where_the_edges_of_an_indenter_are(tmp_path: Path) -> None:
    box, cylinder = Box(size=(4 * MM, 2 * MM, 1 * MM)), Cylinder(radius=2 * MM, height=1 * MM)
    on_box, on_rims = edge_points(box, 0.5 * MM), edge_points(cylinder, 0.5 * MM)
    faces = np.isclose(np.abs(on_box), bounding_size(box) / 2).sum(axis=1)
    assert faces.min() == 2 and (faces == 3).sum() >= 8  # on two faces; and all corners
    assert len(np.unique(on_box.round(9), axis=0)) >= 8 * 4 + 4  # every 0.5 mm of the long ones
    assert np.allclose(np.hypot(*on_rims[:, :2].T), 2 * MM) and np.allclose(np.abs(on_rims[:, 2]), 0.5 * MM)
    assert np.linalg.norm(np.diff(on_rims[: len(on_rims) // 2], axis=0), axis=1).max() <= 0.5 * MM
    drawn = edge_points(stl(tmp_path, trimesh.creation.box((4, 2, 1)), "box.stl"), 0.5 * MM)
    assert np.allclose(
        np.sort(np.unique(drawn.round(9), axis=0), axis=0), np.sort(np.unique(on_box.round(9), axis=0), axis=0)
    )
    assert len(edge_points(Sphere(radius=4 * MM), 1 * MM)) == 0
    ball = trimesh.creation.icosphere(subdivisions=3, radius=4.0)
    assert len(edge_points(stl(tmp_path, ball, "ball.stl"), 1 * MM)) == 0
    turns = np.linspace(0.0, 2 * np.pi, 60, endpoint=False)
    ring = np.stack([np.cos(turns), np.sin(turns), 0.0 * turns], axis=1)
    blunt = trimesh.convex.convex_hull(np.concatenate([4.0 * ring, 1e-3 * ring + [0.0, 0.0, 1.0]]))
    round_its_base = edge_points(stl(tmp_path, blunt, "cone.stl"), 1 * MM)  # and not at its tip, a ring of 2 um
    assert np.allclose(round_its_base[:, 2], -0.5 * MM) and np.allclose(np.hypot(*round_its_base[:, :2].T), 4 * MM)


@pytest.mark.parametrize(
    "geometry", [Box(size=(4 * MM, 5 * MM, 6 * MM)), Sphere(radius=3 * MM), Cylinder(radius=3 * MM, height=4 * MM)]
)
def test_particles_fill_the_shape_evenly(geometry: Shape) -> None:
    spacing = 0.25 * MM
    found = lattice_particles(geometry, spacing)
    assert len(found) * spacing**3 == pytest.approx(enclosed_volume(geometry), rel=0.02)
    assert (shape_distance(geometry, found) <= 1e-12).all()
    assert np.allclose(found.mean(axis=0), 0, atol=1e-12)
    assert np.allclose(np.ptp(found, axis=0) + spacing, bounding_size(geometry))
    steps = (found - found[0]) / spacing
    assert np.allclose(steps, np.rint(steps), atol=1e-9)


def test_mesh_is_filled_like_the_solid_it_describes(tmp_path: Path) -> None:
    geometry = stl(tmp_path, wedge())
    spacing = 0.1 * MM
    found = lattice_particles(geometry, spacing)
    assert enclosed_volume(geometry) == pytest.approx(12e-9, rel=1e-5)
    assert len(found) * spacing**3 == pytest.approx(enclosed_volume(geometry), rel=0.03)
    corner = found / MM + [3, 2, 1.5]  # back to the file's frame: x/6 + y/4 + z/3 <= 1 in the positive octant
    assert (corner > 0).all()
    assert (corner @ [1 / 6, 1 / 4, 1 / 3] <= 1 + 1e-6).all()


def test_mesh_of_a_box_has_the_particles_of_the_box(tmp_path: Path) -> None:
    geometry = stl(tmp_path, trimesh.creation.box((3, 5, 2)).apply_translation([7, -3, 11]))
    assert np.allclose(bounding_size(geometry), [3 * MM, 5 * MM, 2 * MM])
    assert np.allclose(
        lattice_particles(geometry, 0.5 * MM), lattice_particles(Box(size=(3 * MM, 5 * MM, 2 * MM)), 0.5 * MM)
    )


def test_the_nearest_number_of_layers_is_taken() -> None:
    assert np.allclose(np.ptp(lattice_particles(Box(size=(10.2 * MM,) * 3), 0.5 * MM), axis=0), 9.5 * MM)
    assert np.allclose(np.ptp(lattice_particles(Box(size=(10.3 * MM,) * 3), 0.5 * MM), axis=0), 10.0 * MM)


@pytest.mark.parametrize(
    ("geometry", "spacing", "message"),
    [
        (
            Box(size=(1.3 * MM, 4 * MM, 4 * MM)),
            1 * MM,
            r"only 1\.3 mm along x, 1\.3 layers .* 1 mm apart; a body needs 3: choose a particle_spacing of 0\.4333 mm",
        ),
        (
            Box(size=(4 * MM, 3.4 * MM, 4 * MM)),
            1 * MM,
            r"3\.4 mm along y, but 3 layers .* make 3 mm \(-12%, limit 10%\): choose a particle_spacing of 0\.85 mm",
        ),
        (Sphere(radius=0.1 * MM), 1 * MM, r"0\.2 layers .* particle_spacing of 0\.06667 mm, or a size .* times 1 mm"),
        (Box(size=(0.1, 0.1, 0.1 * MM)), 1 * MM, r"0\.1 layers .* needs 3: choose a size"),  # finer: 27 million
        (Box(), 0.01 * MM, r"1,000,000,000 particles .* the limit is 5,000,000: use a larger spacing"),
    ],
)
def test_impossible_spacing_is_refused_with_advice(geometry: Shape, spacing: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        lattice_particles(geometry, spacing)


@pytest.mark.parametrize("layers", [0.3, 1.0, 1.7, 2.0, 2.4, 2.5, 3.4, 4.49])
@pytest.mark.parametrize("kind", ["box", "long box", "cylinder", "sphere", "mesh"])
def test_the_advice_for_thin_bodies_works_when_it_is_followed(kind: str, layers: float, tmp_path: Path) -> None:
    """The first spacing that is advised, and the thickness."""
    spacing = 0.5 * MM

    def shape(thickness: float) -> Shape:
        match kind:
            case "sphere":
                return Sphere(radius=thickness / 2)
            case "cylinder":
                return Cylinder(radius=2 * MM, height=thickness)
            case "mesh":
                return stl(tmp_path, trimesh.creation.box((4, 3, thickness / MM)))
        return Box(size=(4 * MM, (1.17 if kind == "long box" else 3) * max(thickness, MM), thickness))

    thin = shape(layers * spacing)
    with pytest.raises(ValueError, match="choose a particle_spacing of") as refused:
        lattice_particles(thin, spacing)
    advised = re.search(r"particle_spacing of ([\d.]+) mm, .* times ([\d.]+) mm, at least (\d)", str(refused.value))
    assert advised is not None
    found = lattice_particles(thin, float(advised[1]) * MM)
    assert len(np.unique(np.round(found[:, 2] / MM, 9))) >= 3
    assert float(advised[2]) * MM == pytest.approx(spacing)
    if kind != "long box":
        assert len(np.unique(np.round(lattice_particles(shape(int(advised[3]) * spacing), spacing)[:, 2] / MM, 9))) == 3


def test_walls_thinner_than_the_spacing_are_refused(tmp_path: Path) -> None:
    outer, inner = trimesh.creation.box((10, 10, 10)), trimesh.creation.box((8.8, 8.8, 8.8))
    inner.invert()
    geometry = stl(tmp_path, trimesh.util.concatenate([outer, inner]))
    with pytest.raises(ValueError, match=r"miss its volume by \+53% .* thinner than the spacing"):
        lattice_particles(geometry, 1 * MM)


# signed distance


def test_closed_forms_at_known_points() -> None:
    box = Box(size=(2.0, 4.0, 6.0))
    at = [[0, 0, 0], [0.9, 0, 0], [1, 0, 0], [4, 0, 0], [4, 6, 3], [4, 6, 15]]
    assert np.allclose(shape_distance(box, at), [-1, -0.1, 0, 3, 5, 13])
    cylinder = Cylinder(radius=1.0, height=4.0)
    at = [[0, 0, 0], [0, 0, 1.75], [0.6, 0.8, 0], [3, 0, 0], [0, 3, 3.5], [3, 4, 5]]
    assert np.allclose(shape_distance(cylinder, at), [-1, -0.25, 0, 2, 2.5, 5])
    assert np.allclose(shape_distance(Sphere(radius=2.0), [[0, 0, 0], [3, 4, 0]]), [-2, 3])


def test_mesh_distance_is_exact(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    at = rng.uniform(-6, 6, (4000, 3)) * MM
    box = stl(tmp_path, trimesh.creation.box((4, 6, 3)))
    assert np.abs(shape_distance(box, at) - shape_distance(Box(size=(4 * MM, 6 * MM, 3 * MM)), at)).max() < 1e-10
    concave = stl(tmp_path, ell())
    assert np.abs(shape_distance(concave, at) - ell_distance(at / MM) * MM).max() < 1e-10


@pytest.mark.parametrize("case", ["centre of a ball", "coarse beside fine"])
def test_no_nearer_triangle_is_overlooked(tmp_path: Path, case: str) -> None:
    """Hard for a search by centres of triangles: all are equally near, or small ones stand before a large one."""
    rng = np.random.default_rng(3)
    if case == "centre of a ball":
        mesh, points = trimesh.creation.icosphere(3, 4.0), rng.normal(scale=0.2, size=(40, 3))
    else:
        crumb = trimesh.creation.icosphere(3, 0.05).apply_translation([0.0, 0.0, 1.6])
        mesh = trimesh.util.concatenate([trimesh.creation.box((4, 6, 3)), crumb])
        points = rng.uniform([-0.1, -0.1, 1.5], [0.1, 0.1, 1.53], (200, 3))
    geometry = stl(tmp_path, mesh)
    triangles = trimesh.load_mesh(geometry.path).triangles
    found = shape_distance(geometry, (points - mesh.bounds.mean(axis=0)) * MM)
    for at, here in zip(points, found, strict=True):
        brute = trimesh.triangles.closest_point(triangles, np.tile(at, (len(triangles), 1))) - at
        assert abs(here) == pytest.approx(np.linalg.norm(brute, axis=1).min() * MM, abs=1e-10)


def test_the_side_is_right_round_a_sharp_tip(tmp_path: Path) -> None:
    """Across an edge seen at an acute angle the nearest faces disagree about the side; the pseudonormal decides."""
    geometry = stl(tmp_path, wedge())
    tip = np.array([6, 0, 0.0]) - [3, 2, 1.5]
    outward = np.array([1, -0.2, -0.1])
    assert (shape_distance(geometry, (tip + np.outer([0.01, 0.1, 1, 3], outward)) * MM) > 0).all()
    inward = WEDGE.mean(axis=0) - [6, 0, 0]
    assert (shape_distance(geometry, (tip + np.outer([0.01, 0.1, 1.0], inward)) * MM) < 0).all()


def test_the_farthest_point_is_the_middle_of_a_face_that_rounding_tilts() -> None:
    box, cylinder = Box(size=(2.0, 4.0, 6.0)), Cylinder(radius=1.0, height=4.0)
    for noise in (0.0, 1e-7, -1e-7):
        assert farthest_point(box, [noise, -1.0, noise]).tolist() == [0.0, -2.0, 0.0]
        assert farthest_point(cylinder, [noise, noise, 2.0]).tolist() == [0.0, 0.0, 2.0]
        assert farthest_point(cylinder, [-3.0, noise, noise]).tolist() == [-1.0, 0.0, 0.0]
    assert farthest_point(box, [1e-3, -1.0, -1e-3]).tolist() == [1.0, -2.0, -3.0]
    assert farthest_point(cylinder, [0.0, 1e-3, 1.0]).tolist() == [0.0, 1.0, 2.0]
    assert farthest_point(Sphere(radius=2.0), [3.0, 0.0, -4.0]) == pytest.approx([1.2, 0.0, -1.6])


# distance grid


@pytest.mark.parametrize("make", ["sphere", "box", "ell"])
def test_mesh_grid_matches_the_closed_form(tmp_path: Path, make: str) -> None:
    spacing = 0.2 * MM
    mesh, exact, tolerance = {
        "sphere": (trimesh.creation.icosphere(4, 3.0), lambda p: shape_distance(Sphere(radius=3 * MM), p), 6e-6),
        "box": (trimesh.creation.box((4, 6, 3)), lambda p: shape_distance(Box(size=(4 * MM, 6 * MM, 3 * MM)), p), 2e-9),
        "ell": (ell(), lambda p: ell_distance(p / MM) * MM, 2e-9),
    }[make]
    grid = cached_tiled_distance(stl(tmp_path, mesh), spacing)
    values = grid.values(*grid.tile_range(-grid.half, grid.half))
    index = np.stack(np.indices(values.shape), axis=-1).reshape(-1, 3)
    truth, found = exact(grid.origin + spacing * index), values.ravel()
    band = np.abs(truth) < shapes.EXACT_BAND * spacing
    assert (
        np.abs(found - truth)[band].max() < tolerance
    )  # the sphere's is that of its facets, R (1 - cos(half an edge))
    assert (np.sign(found) == np.sign(truth))[~band].all()
    assert (np.abs(found) > np.abs(truth) - tolerance)[~band].all()
    assert found.min() < 0 < found.max()


def test_a_rewritten_file_gives_a_new_grid(tmp_path: Path) -> None:
    """Even with the size and the times of the old one."""
    geometry = stl(tmp_path, trimesh.creation.icosphere(2, 3.0))
    path, grid = Path(geometry.path), cached_tiled_distance(geometry, 0.5 * MM)
    old = path.stat()
    stl(tmp_path, trimesh.creation.icosphere(2, 2.0))
    os.utime(path, ns=(old.st_atime_ns, old.st_mtime_ns))
    assert (path.stat().st_size, path.stat().st_mtime_ns) == (old.st_size, old.st_mtime_ns)
    assert bounding_size(geometry) == pytest.approx(4 * MM, rel=0.05)
    middle = np.zeros((1, 3))
    assert cached_tiled_distance(geometry, 0.5 * MM).sample_distance(middle)[0] == pytest.approx(-2 * MM, rel=0.05)
    assert grid.sample_distance(middle)[0] == pytest.approx(-3 * MM, rel=0.05)


def test_a_file_changed_between_two_looks_is_not_taken_for_the_old_one(tmp_path: Path) -> None:
    geometry = stl(tmp_path, wedge())
    before = file_fingerprint(geometry.path)
    stl(tmp_path, ell())
    with pytest.raises(ValueError, match=r"part\.stl: the file was changed while it was read"):
        load_mesh(geometry.path, geometry.scale, before)


@pytest.mark.parametrize("shape", [Box(size=(4e-3, 6e-3, 5e-3)), Cylinder(radius=2e-3, height=5e-3)])
def test_a_rounded_edge_lies_within_the_size_and_is_as_far_as_it_says(shape: Box | Cylinder) -> None:
    """Farthest points lie on the surface; an edge falls short of the sharp one by (sqrt 2 - 1) of its radius."""
    radius, rng = 0.5e-3, np.random.default_rng(0)
    for direction in [*rng.normal(size=(50, 3)), *np.eye(3)]:
        at = farthest_point(shape, direction, radius)
        assert shape_distance(shape, at[None], radius) == pytest.approx(0.0, abs=1e-12)
        assert shape_distance(shape, at[None]) <= 1e-12
    edge = np.array([[2e-3, 0.0, 2.5e-3]])
    assert shape_distance(shape, edge, radius) == pytest.approx((np.sqrt(2) - 1) * radius)
    assert shape_distance(shape, np.zeros((1, 3)), radius) == pytest.approx(-2e-3)

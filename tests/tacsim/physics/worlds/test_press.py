"""A rigid indenter on one gel: force, contact, frames, meshes."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from benchmarks.truth.layer import layer_contact
from tacsim.geometry import tiles
from tacsim.interface import Pose
from tacsim.models.material import GelMaterial
from tacsim.models.scene import Box, Cylinder, Gel, Mesh, Shape, Sphere
from tacsim.physics.contact.indenter import POINTS
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.worlds import press_state
from tests.tacsim.physics.worlds.pressing import move, world


def layer_force(radius: float, depth: float, nu: float = 0.45) -> float:
    n, side = 192, 30e-3
    x = (np.arange(n) - n / 2) * side / n
    r2 = x[:, None] ** 2 + x**2
    gap = np.where(r2 < radius**2, radius - np.sqrt(np.maximum(radius**2 - r2, 0)), 1.0)
    return layer_contact(gap, depth, side / n, 4e-3, 0.145e6, nu).force


def test_sphere_force_against_the_elastic_layer() -> None:
    """Frictionless, 0.5 mm elements: within 6 % of an independent solver, and closer than 1 mm elements."""
    truth = layer_force(4e-3, 0.4e-3)
    errors = []
    for preset in ("draft", "standard"):
        w = world(Sphere(radius=4e-3), friction=0.0, preset=preset)
        move(w, (0, 0, -0.4e-3 - 0.1e-3))
        errors.append(abs(-w.wrench("lower")[2] / truth - 1))
    assert errors[1] < 0.06
    assert errors[1] < errors[0]


def test_a_nearly_incompressible_gel_does_not_lock() -> None:
    """Full integration at a Poisson ratio of 0.49 would make it far too stiff."""
    w = world(Sphere(radius=4e-3), 0.0, preset="standard", gel=Gel(material=GelMaterial(poisson_ratio=0.49)))
    move(w, (0, 0, -0.3e-3 - 0.1e-3))
    assert -w.wrench("lower")[2] == pytest.approx(layer_force(4e-3, 0.3e-3, 0.49), rel=0.05)


# Axisymmetric finite elements of our own (quadratic, finite strain, rigid ball by a stiff penalty, converged to 0.1 %):
# radius and depth [mm], force [N]; nu 0.48, no friction, element 0.5 mm here.
BALLS = [(2.0, 0.1, 0.0126), (2.0, 0.3, 0.0709), (4.0, 0.1, 0.0190), (4.0, 0.3, 0.1149), (8.0, 0.1, 0.0295)]


@pytest.mark.parametrize(("radius", "depth", "force"), BALLS)
def test_a_shallow_ball_presses_as_on_a_half_space_though_its_contact_is_an_element_wide(
    radius: float, depth: float, force: float
) -> None:
    gel = Gel(material=GelMaterial(poisson_ratio=0.48))
    w = world(Sphere(radius=radius * 1e-3), 0.0, preset="standard", gel=gel)
    move(w, (0, 0, -(depth + 0.1) * 1e-3))
    assert -w.wrench("lower")[2] == pytest.approx(force, rel=0.04)


def test_a_flat_punch_is_no_wider_than_it_is() -> None:
    """By the same finite elements, 0.1 mm deep: its rim is where it is in force and in the moment of a twist."""
    gel = Gel(material=GelMaterial(poisson_ratio=0.48))
    for radius, force in ((2e-3, 0.1428), (3e-3, 0.2936)):
        w = world(Cylinder(radius=radius, height=4e-3), 0.0, preset="standard", gel=gel)
        move(w, (0, 0, -0.2e-3))
        assert -w.wrench("lower")[2] == pytest.approx(force, rel=0.04)
    w = world(Cylinder(radius=3e-3, height=4e-3), 5.0, tolerance=1e-4, preset="standard", gel=gel)
    move(w, (0, 0, -0.2e-3))
    before, turn = w.wrench("lower")[5], np.radians(1.0)
    move(w, (0, 0, 0), turn)
    stiffness = 1.032 * 16 / 3 * 0.145e6 / (2 * 1.48) * 3e-3**3  # of a bonded disc on the layer
    assert w.wrench("lower")[5] - before == pytest.approx(stiffness * turn, rel=0.04)


def test_hardly_anything_overlaps_at_rest_and_backing_balances_contact() -> None:
    w = world(Sphere(radius=4e-3))
    pose = w.pose("indenter")
    stats = w.move({"indenter": Pose(pose.position + [0, 0, -1.1e-3], pose.quaternion)})
    assert stats.settled and stats.residual <= 1e-3
    assert stats.substeps > stats.hold > 0
    for _ in range(10):
        stats = w.move({})
    assert stats.overlap < 25e-6  # what the gel gives way between its nodes, 1 mm apart


def test_an_off_centre_press_shows_where_it_is() -> None:
    """x right, y down, z out: a press at (+3, -2) mm dents the nodes there, and gives the moment its signs."""
    w = world(Sphere(radius=3e-3), tolerance=1e-2)
    move(w, (3e-3, -2e-3, 0))
    move(w, (0, 0, -0.6e-3))
    surface = w.surface("lower")
    i, j = np.unravel_index(np.argmin(surface.displacement[..., 2]), surface.displacement.shape[:2])
    assert surface.origin[0] + i * surface.spacing == pytest.approx(3e-3, abs=0.6e-3)
    assert surface.origin[1] + j * surface.spacing == pytest.approx(-2e-3, abs=0.6e-3)
    force, moment = w.wrench("lower")[:3], w.wrench("lower")[3:]
    assert force[2] < 0
    assert moment == pytest.approx(np.cross([3e-3, -2e-3, -0.5e-3], force), abs=0.1 * np.abs(moment).max())


def test_moving_the_sensor_is_moving_the_indenter() -> None:
    a, b = world(Sphere(radius=4e-3)), world(Sphere(radius=4e-3))
    a.move({"indenter": Pose(a.pose("indenter").position + [0.2e-3, 0, -0.6e-3])})
    b.move({"lower": Pose(np.array([-0.2e-3, 0, 0.6e-3]))})
    assert a.wrench("lower") == pytest.approx(b.wrench("lower"), abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "within"), [(0.6, 5e-4), (3.0, 1e-5)])
def test_twists_to_and_fro_take_nothing(friction: float, within: float) -> None:
    """What sticks to the ball turns with it. With an elastic slip that was summed up from velocities, in the sensor's
    axes, force rose by 0.3 % from the fifth to the twentieth cycle; where nothing slips (3.0) by 0.01 %."""
    w = world(Sphere(radius=4e-3), friction, preset="draft")
    move(w, (0, 0, -0.9e-3))
    forces = []
    for _ in range(20):
        move(w, (0, 0, 0), turn=0.15)
        move(w, (0, 0, 0))
        forces.append(-w.wrench("lower")[2])
    assert forces[19] == pytest.approx(forces[4], rel=within)


def test_a_twist_gives_a_moment_about_z_of_the_same_sense() -> None:
    w = world(Box(size=(6e-3, 4e-3, 4e-3)))
    move(w, (0, 0, -0.4e-3))
    move(w, (0, 0, 0), turn=0.05)
    assert w.wrench("lower")[5] > 1e-4


def test_lift_off_leaves_nothing_behind() -> None:
    w = world(Sphere(radius=4e-3))
    move(w, (0.3e-3, 0, -0.8e-3))
    move(w, (0, 0, 2e-3))
    assert np.abs(w.wrench("lower")).max() == 0
    assert np.abs(w.surface("lower").displacement).max() < 2e-6


@pytest.mark.slow
def test_a_mesh_presses_like_its_closed_form(tmp_path: object) -> None:
    import trimesh

    path = f"{tmp_path}/ball.stl"
    trimesh.creation.icosphere(4, radius=4.0).export(path)
    a, b = world(Sphere(radius=4e-3)), world(Mesh(path=path))
    for w in (a, b):
        move(w, (0, 0, -0.6e-3))
    assert b.wrench("lower")[2] == pytest.approx(a.wrench("lower")[2], rel=0.03)
    assert np.abs(a.surface("lower").displacement - b.surface("lower").displacement).max() < 10e-6


def brick(folder: Path, size: tuple[float, float, float]) -> tuple[Box, Mesh]:
    """The same box [mm] in closed form and as an STL file."""
    import trimesh

    trimesh.creation.box(size).export(folder / "brick.stl")
    return Box(size=tuple(side * 1e-3 for side in size)), Mesh(path=str(folder / "brick.stl"))


@pytest.mark.slow
def test_a_mesh_wider_than_the_gel_is_there_wherever_it_is_moved(tmp_path: Path) -> None:
    """Its far ends, brought over the gel after it was pressed, and by a turn, press as those of the closed form.

    No friction: what an edge that ploughs drags depends on which contact point it meets first (5 % at 0.2).
    """
    forces = []
    for shape in brick(tmp_path, (18, 5, 2)):
        w = world(shape, 0.0, preset="draft", gel=Gel(size=(6e-3, 6e-3, 4e-3)))
        found = []
        for by, turn in (((0, 0, -0.4e-3), 0.0), ((7e-3, 0, 0), 0.0), ((0, 0, 0), 0.5)):
            move(w, by, turn)
            found.append(-w.wrench("lower")[2])
        forces.append(found)
    assert forces[1] == pytest.approx(forces[0], rel=0.02) and min(forces[0]) > 0.2


@pytest.mark.slow
def test_mesh_on_its_side_presses_like_closed_form(tmp_path: Path) -> None:
    lying, forces = np.array([0, np.sin(np.pi / 4), 0, np.cos(np.pi / 4)]), []
    for shape in brick(tmp_path, (2, 2, 10)):
        w = world(shape, preset="draft", gel=Gel(size=(6e-3, 6e-3, 4e-3)))
        for height in (9e-3, 1.1e-3, 0.7e-3):
            assert w.move({"indenter": Pose(np.array([0, 0, height]), lying)}).settled
        forces.append(w.wrench("lower")[2])
    assert forces[1] == pytest.approx(forces[0], rel=1e-3) and forces[0] < -0.2


@pytest.mark.slow
def test_mesh_distances_cover_both_ends_of_launch_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each alone would be allowed; the second must not stand in the place of the first."""
    w = world(brick(tmp_path, (18, 5, 2))[1], preset="draft", gel=Gel(size=(6e-3, 6e-3, 4e-3)))
    drive = np.zeros((2, 1, 6, 3), np.float32)
    drive[:, 0, :3] = np.eye(3)
    drive[:, 0, 3] = (-7.0, 0.0, 1.0), (7.0, 0.0, 1.0)
    for module in (press_state, tiles):
        monkeypatch.setattr(
            module, "MAX_NODES", 8 * tiles.TILE_NODES**3
        )  # an end has 6 tiles, both and what is between 12
    with pytest.raises(ValueError, match="192 x 64 x 32 nodes"):
        w.cover(drive)
    w.cover(drive[:1])
    assert w.state._values.shape == (1, 96, 64, 32)


def test_the_grids_of_all_environments_together_are_bounded(tmp_path: Path) -> None:
    """Each has as much room along each axis as the one that needs most there."""
    state = world(brick(tmp_path, (2, 2, 2))[1], preset="draft").state
    counts = state.counts.copy()
    laid = state._values = np.broadcast_to(np.float32(0), (1, 2**29, 1, 1))  # without memory
    with pytest.raises(MemoryError, match="the limit of kernels is"):
        state.cover(0, np.zeros(3), np.ones(3))
    assert state._values is laid and np.array_equal(state.counts, counts)


@pytest.mark.slow
@pytest.mark.cpu
def test_second_world_of_mesh_reads_file_without_new_distances(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So it is ready in milliseconds, and a rewritten file is still seen."""
    import trimesh

    def write(radius: float) -> Mesh:
        trimesh.creation.icosphere(2, radius=radius).export(tmp_path / "ball.stl")
        return Mesh(path=str(tmp_path / "ball.stl"))

    computed: list[str] = []

    def count(name: str) -> None:
        real = getattr(tiles, name)
        monkeypatch.setattr(tiles, name, lambda *given: (computed.append(name), real(*given))[1])

    count("centred_mesh")
    count("signed_distance_on_grid")
    first = world(write(3.0))
    move(first, (0, 0, -0.4e-3))
    assert computed.count("centred_mesh") == 1 and 1 <= computed.count("signed_distance_on_grid") <= 9
    computed.clear()
    second = world(write(3.0))
    move(second, (0, 0, -0.4e-3))
    assert computed == []
    assert first.wrench("lower")[2] < -0.01 and first.wrench("lower").tobytes() == second.wrench("lower").tobytes()
    third = world(write(2.0))
    move(third, (0, 0, -0.4e-3))
    assert computed.count("centred_mesh") == 1
    assert third.pose("indenter").position[2] == pytest.approx(1.7e-3, rel=0.01)


def owned(thing: object) -> Iterator[np.ndarray]:
    """All arrays that an object of ours holds, also within others of ours."""
    for value in vars(thing).values():
        for part in value if isinstance(value, list | tuple) else [value]:
            if isinstance(part, np.ndarray):
                yield part
            elif type(part).__module__.startswith("tacsim.physics") and hasattr(part, "__dict__"):
                yield from owned(part)


@pytest.mark.cpu
def test_a_press_allocates_no_particles_or_grid() -> None:
    """Its state is the gel, three numbers and one of each contact point on it, and little besides."""
    w = world(Sphere(radius=4e-3))
    move(w, (0, 0, -0.3e-3))
    state = w.state
    nx, ny, _ = state.gel[0].elements
    points = 4 * POINTS**2 * nx * ny + (nx + 1) * (ny + 1)
    assert sum(a.size for a in owned(state)) < sum(a.size for a in owned(state.gels)) + points + 1000
    assert not {"body", "particles", "memory"} & set(vars(state))
    assert w.truth() is None
    assert set(w.snapshot()) == {
        "gel_displacement", "gel_velocity", "anchor", "pressure", "carried", "sums", "poses", "rates", "true_inertia",
        "touched",
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["closed form", "mesh"])
def test_contact_forgets_what_it_no_longer_touches(kind: str, tmp_path: Path) -> None:
    """Memory left behind would pull at the gel in the next touch. A mesh's distances end close to its surface."""
    box: Shape = Box(size=(6e-3, 6e-3, 4e-3))
    if kind == "mesh":
        import trimesh

        trimesh.creation.box((6.0, 6.0, 4.0)).export(tmp_path / "box.stl")
        box = Mesh(path=str(tmp_path / "box.stl"))
    w = world(box, tolerance=1e-2, preset="draft")
    move(w, (0, 0, -0.5e-3))
    w.move({"indenter": Pose(w.pose("indenter").position + [2.3e-3, 0, 0])})  # by sharp edges: not called settled
    touched = w.snapshot()
    assert touched["anchor"].any() and touched["pressure"].any()
    move(w, (0, 0, 6e-3))
    far = w.snapshot()
    assert not far["anchor"].any() and not far["pressure"].any()


def test_an_indenter_that_fits_between_the_contact_points_is_refused() -> None:
    for shape in (Sphere(radius=0.1e-3), Box(size=(0.3e-3, 4e-3, 4e-3)), Cylinder(radius=0.2e-3, height=4e-3)):
        with pytest.raises(ValueError, match=r"fits between .* 0\.3333 mm apart .* choose element_size at most 0\."):
            world(shape, preset="draft")
    assert world(Sphere(radius=0.24e-3), preset="draft")
    with pytest.raises(ValueError, match=r"at most 0\.2105 mm"):
        world(Sphere(radius=0.05e-3), preset="draft")
    assert world(Sphere(radius=0.05e-3), element_size=0.2105e-3, gel=Gel(size=(4e-3, 4e-3, 4e-3)))


def test_a_tip_that_passes_between_the_contact_points_is_an_error(tmp_path: Path) -> None:
    """A needle below a plate: by its width it may be pressed, so only the way down shows it."""
    import trimesh

    needle = trimesh.creation.box((0.1, 0.1, 2.0))
    plate = trimesh.creation.box((4.0, 4.0, 1.0)).apply_translation((0, 0, 1.5))
    trimesh.util.concatenate([needle, plate]).export(tmp_path / "needle.stl")
    w = world(Mesh(path=str(tmp_path / "needle.stl")), preset="draft", gel=Gel(size=(6e-3, 6e-3, 4e-3)))
    move(w, (0, 0, -0.2e-3))
    before = w.snapshot()
    with pytest.raises(SimulationDiverged, match=r"0\.4 mm deep .* no contact point .* such as 0\.5 mm") as passed:
        move(w, (0, 0, -0.3e-3))
    assert passed.value.refine == 1  # no smaller step would help
    assert {"lower", "indenter"} == set(passed.value.poses)
    assert passed.value.good.keys() == passed.value.failed.keys() == w.arrays().keys()  # for a dump
    assert all(before[name].tobytes() == a.tobytes() for name, a in w.snapshot().items())


def test_edge_between_contact_points_is_error_even_if_it_ends_outside_gel() -> None:
    """A plate on its edge, longer than the gel and tilted by rounding: its lowest corner is beside the gel."""
    w = world(Box(size=(12e-3, 2e-3, 0.1e-3)), preset="draft", gel=Gel(size=(6e-3, 6e-3, 4e-3)))
    tilted = np.array([np.sin(np.pi / 4), 1e-7, 0.0, np.cos(np.pi / 4)])
    w.move({"indenter": Pose(np.array([0, 0, 3e-3]), tilted)})
    with pytest.raises(SimulationDiverged, match=r"0\.4 mm deep .* no contact point"):
        w.move({"indenter": Pose(np.array([0, 0, 0.6e-3]), tilted)})

"""Dynamic motions: closed forms in real time, what stays between motions, what is refused."""

import numpy as np
import pytest

from tacsim.interface import Pose
from tacsim.models.material import BodyMaterial, GelMaterial
from tacsim.models.scene import Body, Box, Gel, Indenter, Scene, Sphere
from tacsim.physics.motion.tuning import MAX_DRIVE_MACH
from tacsim.physics.seed.world import SeedWorld
from tacsim.physics.world import World
from tacsim.physics.worlds.hybrid import HybridWorld
from tacsim.physics.worlds.press import PressWorld
from tests.tacsim.physics.motion.energy import total_energy

CUBE = Body(geometry=Box(size=(4e-3, 4e-3, 4e-3)))
GEL = Gel(size=(12e-3, 12e-3, 2e-3))


def along_z(world: World, name: str, by: float) -> dict[str, Pose]:
    pose = world.pose(name)
    return {name: Pose(pose.position + (0, 0, by), pose.quaternion)}


def test_a_body_in_the_air_falls_by_half_g_t_squared() -> None:
    world = HybridWorld(Scene(gravity=(0, 0, -9.81), body=CUBE, gel=GEL))
    start, time = world.truth().position[2], 0.0
    for duration in (1e-3, 2e-3):  # the speed of the first motion stays for the second
        substeps = world.move({}, duration=duration).substeps
        time += duration
    step = duration / substeps
    assert world.truth().position[2] - start == pytest.approx(-0.5 * 9.81 * time * (time + step), rel=2e-3)


def test_a_gel_shakes_at_its_quarter_wave() -> None:
    """A wide layer bonded below, released from u_x = a sin(pi z / 2 H), swings with period 4 H / c_s, undamped."""
    material = GelMaterial(poisson_ratio=0.45, density=1200.0)
    world = PressWorld(Scene(body=None, indenter=Indenter(), gel=Gel(size=(48e-3, 48e-3, 4e-3), material=material)))
    state = dict(world.snapshot())
    shape = np.zeros_like(state["gel_displacement"])
    shape[..., 0] = 0.02 * np.sin(np.linspace(0, np.pi / 2, shape.shape[-2]))
    state["gel_displacement"] = shape
    world.restore(state)
    period = 4 * 4e-3 / np.sqrt(0.145e6 / (2 * 1.45) / 1200.0)
    for turn in (-1.0, 1.0):
        world.move({}, duration=period / 2)
        middle = world.surface("lower").displacement[24, 24, 0]
        assert middle == pytest.approx(turn * 20e-6, rel=0.03), turn  # later, waves from the rim come in
    world.move({}, duration=period / 4)
    assert abs(world.surface("lower").displacement[24, 24, 0]) < 2e-6


def test_the_period_of_a_gel_converges_at_second_order_in_element_and_step() -> None:
    """The quarter wave again, of a gel without a Poisson ratio: nothing from the rims reaches its middle in the first
    three quarters of the period. u = a cos(w t + phase), whose phase, half a substep, the second quarter cancels."""
    material = GelMaterial(poisson_ratio=0.0)
    gel = Gel(size=(40e-3, 4e-3, 4e-3), material=material)
    quarter, height, errors = 4e-3 / np.sqrt(material.youngs_modulus / 2 / material.density), 10e-6, []
    for element in (1e-3, 0.5e-3, 0.25e-3):
        world = PressWorld(Scene(body=None, indenter=Indenter(), gel=gel, element_size=element))
        state = dict(world.snapshot())
        shape = np.zeros_like(state["gel_displacement"])
        shape[..., 0] = height * 1e3 * np.sin(np.linspace(0, np.pi / 2, shape.shape[-2]))
        state["gel_displacement"] = shape
        world.restore(state)
        ends = []
        for _ in range(3):
            world.move({}, duration=quarter)
            surface = world.surface("lower").displacement
            ends.append(float(surface[surface.shape[0] // 2, surface.shape[1] // 2, 0]))
        late = np.arcsin(ends[0] / height) + np.arcsin(ends[2] / height)  # in half a period, as an angle
        errors.append(abs(late) / np.pi)
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert orders == pytest.approx(2.0, abs=0.1)
    assert errors[0] < 0.01


@pytest.mark.slow
def test_bounced_body_has_momentum_measured_by_gel() -> None:
    """Thrown at the lower gel, an elastic cube comes back; what it gained is the impulse of the contact force, and in
    the air it loses none of it."""
    world = HybridWorld(Scene(body=CUBE, gel=GEL))
    world.move(along_z(world, "upper", 5e-3))  # out of the way
    world.move({}, duration=1e-6)
    thrown = dict(world.snapshot())
    speed = 0.7  # [m/s]
    thrown["velocity"] = np.full_like(thrown["velocity"], (0, 0, -speed / 35.688))  # over the gel's wave speed
    del thrown["grid_velocity"]  # the particles' holds
    world.restore(thrown)
    substep = world._true.step / world._true.second
    places, impulse = [world.truth().position[2]], 0.0
    for _ in range(250):
        assert world.move({}, duration=0.999 * substep).substeps == 1
        impulse -= float(world.wrench("lower")[2]) * 0.999 * substep
        places.append(float(world.truth().position[2]))
    speeds = np.diff(places) / (0.999 * substep)
    mass = 1700.0 * 4e-3**3
    assert speeds[0] == pytest.approx(-speed, rel=1e-3)
    assert 0.4 * speed < speeds[-1] < speed
    assert impulse == pytest.approx(mass * (speeds[-1] - speeds[0]), rel=0.01)
    assert speeds[-40:-30].mean() == pytest.approx(speeds[-10:].mean(), rel=1e-3)


def test_sensors_that_do_not_touch_leave_the_body_alone() -> None:
    world = HybridWorld(Scene(body=CUBE, gel=GEL))
    start = world.truth().position
    world.move(along_z(world, "upper", 2e-3))
    assert np.array_equal(world.truth().position, start)


def test_without_a_duration_what_moved_stops() -> None:
    world = HybridWorld(Scene(gravity=(0, 0, -9.81), body=CUBE, gel=GEL))
    world.move({}, duration=2e-3)
    assert world.snapshot()["velocity"][:, 2].mean() < 0
    world._switch_inertia(world._scaled)
    assert np.abs(world.snapshot()["velocity"]).max() == 0


@pytest.mark.cpu
def test_a_snapshot_keeps_the_kind_of_inertia() -> None:
    world = HybridWorld(Scene(gravity=(0, 0, -9.81), body=CUBE, gel=GEL))
    world.move({}, duration=1e-3)
    falling = world.snapshot()
    world.move({}, duration=1e-3)
    end = world.truth().position
    world._switch_inertia(world._scaled)
    world.restore(falling)
    world.move({}, duration=1e-3)
    assert np.array_equal(world.truth().position, end)


@pytest.mark.cpu
def test_quasi_static_motions_do_not_know_the_density() -> None:
    """Scaled inertia: the path alone counts, so a heavier gel ends with the same bits."""
    ends = []
    for density in (1000.0, 3000.0):
        gel = GEL.model_copy(update={"material": GelMaterial(density=density)})
        world = PressWorld(Scene(body=None, indenter=Indenter(), gel=gel))
        world.move(along_z(world, "indenter", -0.2e-3))
        ends.append(world.surface("lower").displacement)
    assert np.array_equal(*ends)


@pytest.mark.parametrize(
    ("duration", "words"), [(0.0, "positive"), (-1.0, "positive"), (float("nan"), "positive"), (1e-5, "at least")]
)
def test_a_duration_that_makes_no_sense_is_refused(duration: float, words: str) -> None:
    world = HybridWorld(Scene(body=CUBE, gel=GEL))
    before = world.snapshot()
    with pytest.raises(ValueError, match=words):
        world.move(along_z(world, "lower", 1e-3), duration=duration)
    assert all(np.array_equal(before[name], array) for name, array in world.snapshot().items())


@pytest.mark.parametrize("duration", [5e-324, 1e-300, 1e5, 1e305, 1e308])
def test_a_duration_of_no_substep_or_of_far_too_many_is_refused(duration: float) -> None:
    world = PressWorld(Scene(body=None, indenter=Indenter(), gel=GEL))
    with pytest.raises(ValueError, match=r"duration is .* s; .* it must lie between .* is it in seconds\?"):
        world.move({}, duration=duration)


def test_the_advice_for_a_longer_duration_holds() -> None:
    world = PressWorld(Scene(body=None, indenter=Indenter(), gel=GEL))
    with pytest.raises(ValueError, match="at least") as refused:
        world.move(along_z(world, "indenter", -0.1e-3), duration=1e-5)
    longer = float(str(refused.value).rsplit("at least ", 1)[1].split()[0])
    assert world.move(along_z(world, "indenter", -0.1e-3), duration=1.01 * longer).hold == 0
    assert MAX_DRIVE_MACH < 0.5


@pytest.mark.cpu
def test_loads_and_the_seed_have_no_duration() -> None:
    with pytest.raises(ValueError, match="loads"):
        HybridWorld(Scene(body=CUBE, gel=GEL)).move({}, loads={"upper": 0.1}, duration=1e-3)
    with pytest.raises(ValueError, match="seed"):
        SeedWorld(Scene(body=CUBE, gel=GEL, physics="seed")).move({}, duration=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "yield_stress"), [(0.02, None), (0.6, None), (3.0, None), (0.6, 3e4), (3.0, 5e3)])
def test_a_squeezed_body_held_still_keeps_its_force_and_its_energy(friction: float, yield_stress: float | None) -> None:
    """With the memory of contact that quasi-static motions have, the force was 17 % off after 0.03 s; with radii of
    particles that follow their strain, energy grew by a fifth from 0.25 to 0.45 s without friction."""
    body = Body(geometry=Box(size=(8e-3, 8e-3, 8e-3)), material=BodyMaterial(yield_stress=yield_stress))
    both = {"lower": friction, "upper": friction}
    world = HybridWorld(Scene.model_validate({"preset": "learn", "body": body, "friction": both}))
    world.move(along_z(world, "upper", -1.2e-3))
    world.move({}, duration=1e-5)
    energies, forces = [total_energy(world)], [np.abs([world.wrench(name)[2] for name in world.sensors])]
    for _ in range(20):
        world.move({}, duration=0.01)
        energies.append(total_energy(world))
        forces.append(np.abs([world.wrench(name)[2] for name in world.sensors]))
    assert np.array(forces) == pytest.approx(forces[0].mean(), rel=1e-3)
    # what the step's order, positions after velocities, makes of a constant energy
    assert max(np.array(energies[1:]) / np.minimum.accumulate(energies[:-1])) < 1 + 2e-4


def test_a_body_squeezed_without_friction_has_no_motion_in_real_time() -> None:
    smooth = {"lower": 0.0, "upper": 0.0}
    world = HybridWorld(Scene.model_validate({"preset": "learn", "body": CUBE, "friction": smooth}))
    world.move({}, duration=1e-4)  # the body lies on one gel: nothing squeezes it
    world.move(along_z(world, "upper", -0.5e-3))
    before = world.wrench("upper")
    with pytest.raises(ValueError, match="are 0: a body that gels squeeze without friction"):
        world.move({}, duration=1e-3)
    assert np.array_equal(world.wrench("upper"), before)


def test_a_real_time_hold_begins_with_the_forces_of_the_rest_before_it() -> None:
    """Springs of contact have another stiffness by the true density: they must take over forces, not overlaps."""
    material = BodyMaterial(density=300.0)
    body = Body(geometry=Box(size=(8e-3, 8e-3, 8e-3)), material=material)
    world = HybridWorld(Scene.model_validate({"preset": "learn", "body": body, "settling": {"tolerance": 1e-4}}))
    world.move(along_z(world, "upper", -1.2e-3))
    before = [world.wrench(name)[2] for name in world.sensors]
    world.move({}, duration=1e-5)
    assert [world.wrench(name)[2] for name in world.sensors] == pytest.approx(before, rel=5e-3)
    world.move({})
    assert [world.wrench(name)[2] for name in world.sensors] == pytest.approx(before, rel=5e-3)


@pytest.mark.slow
def test_a_pressed_gel_held_still_keeps_its_force() -> None:
    """Without friction its force swung, and fell from 0.92 to 0.88 N in a second."""
    ball = Indenter(geometry=Sphere(radius=4e-3), friction=0.0)
    world = PressWorld(Scene(body=None, preset="learn", indenter=ball))
    world.move(along_z(world, "indenter", -1.1e-3))
    world.move({}, duration=1e-5)
    forces = [world.wrench("lower")[2]]
    for _ in range(10):
        world.move({}, duration=0.1)
        forces.append(world.wrench("lower")[2])
    assert forces == pytest.approx([forces[0]] * 11, rel=1e-3)

"""Guards, rollback and retries, on a world of one particle and on real ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tacsim.interface import Pose
from tacsim.models.scene import Gel, Indenter, Scene, Settling, Sphere
from tacsim.physics.failure import diagnosis, health
from tacsim.physics.failure.health import Health, LaunchSpan, SimulationDiverged, check_launch, require_grid_memory
from tacsim.physics.failure.tuning import MAX_COURANT
from tacsim.physics.motion.controller import ForceReading, Launch, Motion, run_motion
from tacsim.physics.motion.path import Path
from tacsim.physics.move import MoveCommand, MoveStats
from tacsim.physics.snapshot import copy_arrays
from tacsim.physics.worlds import press
from tacsim.physics.worlds.base import BaseWorld
from tacsim.physics.worlds.press import PressWorld
from tacsim.physics.worlds.tuning import MAX_RETRIES, PRESS_COURANT

BALL = Scene(body=None, indenter=Indenter(geometry=Sphere(radius=4e-3)), gel=Gel(size=(10e-3, 10e-3, 4e-3)))
STILL = Path([Pose()], [Pose()], substeps=0, dt=0.4)
REST = ForceReading(np.zeros((1, 3)), np.zeros((1, 3)), 1.0, 0.0, 0)
STATS = MoveStats(10, 5, 0.001, True, 0.0, 0)
HERE = LaunchSpan("in substeps 0 to 20 of 40 of the motion", {"lower": Pose(np.array([0, 0, 1e-3]))})
WELL = Health(1.0, 0, 1.0, 0.01, 0, 0.0)


def one_launch(refine: int) -> Motion:
    """A motion of a single launch, whose path tells `refine`."""
    yield Launch(replace(STILL, refine=refine), 0, 1)
    return STATS


class Particles(BaseWorld):
    """A world whose motion is a single launch, which a test carries out."""

    sensors = ("lower", "upper")

    def __init__(self) -> None:
        self.scene, self._poses = Scene(), {"lower": Pose(), "upper": Pose()}
        self.state = {"position": np.ones((4, 3), np.float32), "velocity": np.zeros((4, 3), np.float32)}

    def _run_command(self, command: MoveCommand) -> Motion:
        return self._retry_smaller_steps(command, one_launch)

    def _advance(self, launch: Launch) -> list[ForceReading]:
        raise AssertionError("the test advances it")

    def arrays(self) -> dict[str, np.ndarray]:
        return self.state

    def snapshot(self) -> dict[str, np.ndarray]:
        return {name: a.copy() for name, a in self.state.items()}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        for name, a in self.state.items():
            a[...] = state[name]

    def launch(self, change: Callable[[dict[str, np.ndarray]], Any], seen: Health = WELL) -> Health:
        good = copy_arrays(self.state)
        change(self.state)
        return check_launch(self.arrays, good, seen, lambda: HERE)


def set_to(name: str, index: tuple[int, ...], value: float) -> Callable[[dict[str, np.ndarray]], None]:
    def change(arrays: dict[str, np.ndarray]) -> None:
        arrays[name][index] = value

    return change


def nothing(arrays: dict[str, np.ndarray]) -> None:
    del arrays


@pytest.mark.parametrize(
    ("seen", "words"),
    [
        (Health(0.01, 0, 1.0, 0.0, 0, 0.0), "inverted or crushed (volume ratio 0.01)"),
        (Health(float("nan"), 0, 1.0, 0.0, 0, 0.0), "inverted or crushed"),
        (Health(1.0, 0, 0.05, 0.0, 0, 0.0), "lost its volume in one substep"),
        (Health(1.0, 0, 1.0, 0.7, 0, 0.0), "0.7 of the wave speed (limit 0.5)"),
        (Health(1.0, 3, 1.0, 0.0, 0, 0.0), "left the grid (3 particle substeps)"),
        (
            Health(1.0, 0, 1.0, 0.0, 0, 0.0, 1.2),
            "1.2 of the pressure wave's time through the most compressed element or grid cell (limit 1)",
        ),
    ],
)
def test_check_launch_reports_results_of_kernels(seen: Health, words: str) -> None:
    with pytest.raises(SimulationDiverged) as caught:
        Particles().launch(nothing, seen)
    assert words in caught.value.cause and "lower at (0.000, 0.000, 1.000) mm" in caught.value.where


def test_a_sound_launch_passes() -> None:
    assert Particles().launch(set_to("position", (1, 2), 1.5)) == WELL


def test_the_cause_names_array_index_and_how_many() -> None:
    with pytest.raises(SimulationDiverged, match=r"velocity\[2, 1\] is nan, with 1 more of 12"):
        Particles().launch(lambda a: a["velocity"].__setitem__((slice(2, 4), 1), np.nan))


def test_fast_gel_node_and_crushed_particle_are_detected() -> None:
    world = Particles()
    world.state["gel_velocity"] = np.zeros((1, 2, 2, 2, 3), np.float32)
    with pytest.raises(SimulationDiverged, match=r"gel node moves at 0\.6 of the wave speed"):
        world.launch(set_to("gel_velocity", (0, 1, 1, 1, 2), -0.6))
    world = Particles()
    world.state["strain"] = np.zeros((4, 6), np.float32)
    with pytest.raises(SimulationDiverged, match=r"a particle is crushed \(elastic volume ratio 0\.0316\)"):
        world.launch(set_to("strain", (3, 2), -0.999))


def test_what_has_spread_over_a_gel_is_placed_where_it_began() -> None:
    good = {"gel_displacement": np.zeros((1, 3, 3, 2, 3)), "gel_velocity": np.zeros((1, 3, 3, 2, 3))}
    good["gel_velocity"][0, 1, 1, 1, 2] = -0.4
    failed = {name: np.full_like(array, np.nan) for name, array in good.items()}
    place = diagnosis.describe_worst_place("node speed", good, failed, [(4e-3, 4e-3, 2e-3)])
    assert place.startswith("node [1, 1, 1] of the lower gel, (0.000, 0.000, 0.000) mm")
    failed["gel_velocity"][...], failed["gel_velocity"][0, 2, 0, 0, 1] = 0.1, 3.0
    assert "node [2, 0, 0]" in diagnosis.describe_worst_place("node speed", good, failed, [(4e-3, 4e-3, 2e-3)])


def test_a_motion_starts_again_from_the_state_before_it() -> None:
    world, seen = Particles(), []

    def advance(launch: Launch) -> list[ForceReading]:
        seen.append((launch.path.refine, float(world.state["position"][0, 0])))
        world.state["position"] += 1.0
        world.launch(set_to("velocity", (0, 0), 0.0 if launch.path.refine == 2 else np.nan))
        return [REST]

    stats = run_motion(world.motion(MoveCommand({})), advance)
    assert seen == [(1, 1.0), (2, 1.0)]
    assert stats.retries == 1 and world.state["position"][0, 0] == 2.0


def test_a_motion_that_never_succeeds_leaves_the_world_as_it_was() -> None:
    world, steps = Particles(), []
    before = world.snapshot()

    def advance(launch: Launch) -> list[ForceReading]:
        steps.append(launch.path.refine)
        world.launch(nothing)
        world.launch(lambda a: (a["position"].__iadd__(2.0), a["velocity"].__setitem__((1, 0), np.inf)))
        return [REST]

    with pytest.raises(SimulationDiverged) as caught:
        run_motion(world.motion(MoveCommand({})), advance)
    assert steps == [2**retry for retry in range(MAX_RETRIES + 1)]
    assert all(world.state[name].tobytes() == before[name].tobytes() for name in before)
    text = str(caught.value)
    assert "velocity[1, 0] is inf at particle 1, (1.000, 1.000, 1.000) mm in the world" in text
    assert f"even with 1/{2**MAX_RETRIES} of the time step" in text and "move less far" in text
    assert caught.value.good["position"][0, 0] == 1.0 and caught.value.failed["position"][0, 0] == 3.0


def test_of_two_motions_in_step_one_fails_and_the_other_goes_on() -> None:
    """As whoever advances many worlds at once does: a failure is thrown into its own motion only."""
    good, bad = Particles(), Particles()
    motions = [good.motion(MoveCommand({})), bad.motion(MoveCommand({}))]
    launches = [next(motion) for motion in motions]
    good.state["position"] += 1.0
    bad.state["position"] += 1.0
    with pytest.raises(StopIteration) as ended:
        motions[0].send([REST])
    again = motions[1].throw(SimulationDiverged("too fast", HERE))
    assert ended.value.value == STATS
    assert (launches[1].path.refine, again.path.refine) == (1, 2)
    assert good.state["position"].max() == 2.0 and bad.state["position"].max() == 1.0


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_an_interrupted_motion_is_taken_back(error: type[BaseException]) -> None:
    world = Particles()

    def advance(launch: Launch) -> list[ForceReading]:
        world.state["position"] += 1.0
        raise error

    with pytest.raises(error):
        run_motion(world.motion(MoveCommand({})), advance)
    assert world.state["position"].max() == 1.0


def test_state_with_nan_is_refused_before_motion() -> None:
    world = Particles()
    world.state["position"][3, 0] = np.nan
    with pytest.raises(
        SimulationDiverged, match=r"position\[3, 0\] is nan.*before the motion began.*restore a snapshot"
    ):
        run_motion(world.motion(MoveCommand({})), lambda path, first, last: pytest.fail("it moved"))


def test_a_grid_without_end_is_refused() -> None:
    require_grid_memory(np.zeros(3), np.full(3, 100.0), 1.0, lambda: HERE)
    with pytest.raises(SimulationDiverged, match="spread over 1000 x 1000 x 1000 mm"):
        require_grid_memory(np.zeros(3), np.full(3, 1000.0), 1.0, lambda: HERE)
    with pytest.raises(SimulationDiverged):
        require_grid_memory(np.zeros(3), np.array([1.0, 1.0, 1e38], np.float32), 1e-3, lambda: HERE)


def test_volumes_are_those_of_the_determinant() -> None:
    rng = np.random.default_rng(0)
    u = rng.normal(0, 0.3, (2, 4, 3, 5, 3)).astype(np.float32)
    centres, corners = (f(u, 2.0) for f in (diagnosis.element_volumes, diagnosis.corner_volumes))
    assert centres.shape == corners.shape == (2, 3, 2, 4)
    h = 0.5
    for gel, i, j, k in np.ndindex(centres.shape):
        cell = u[gel, i : i + 2, j : j + 2, k : k + 2].astype(np.float64)
        edges = [np.diff(cell, axis=axis) / h for axis in range(3)]
        mean = np.stack([edge.mean(axis=(0, 1, 2)) for edge in edges], axis=1)
        assert centres[gel, i, j, k] == pytest.approx(np.linalg.det(np.eye(3) + mean), rel=1e-6, abs=1e-9)
        least = min(
            np.linalg.det(np.eye(3) + np.stack([edges[0][0, b, c], edges[1][a, 0, c], edges[2][a, b, 0]], axis=1))
            for a, b, c in np.ndindex(2, 2, 2)
        )
        assert corners[gel, i, j, k] == pytest.approx(least, rel=1e-6, abs=1e-9)
    assert not diagnosis.has_small_gradients(u, 2.0)
    assert diagnosis.has_small_gradients(0.1 * h * np.sign(u), 2.0)

    f = np.eye(3) + rng.normal(0, 0.2, (50, 3, 3))
    volumes = diagnosis.particle_volumes({"deformation_gradient": f})
    assert volumes == pytest.approx(np.linalg.det(f), rel=1e-9)
    e = f @ np.swapaxes(f, 1, 2) - np.eye(3)
    six = np.stack([e[:, 0, 0], e[:, 1, 1], e[:, 2, 2], e[:, 0, 1], e[:, 0, 2], e[:, 1, 2]], axis=1)
    assert diagnosis.particle_volumes({"strain": six}) == pytest.approx(np.abs(np.linalg.det(f)), rel=1e-9)


def test_launch_span_text_contains_frame_positions() -> None:
    path = Path([Pose()], [Pose(np.array([0, 0, 2e-3]))], substeps=40, dt=0.4)
    assert str(path.span(["lower"], 0, 20)) == (
        "in substeps 0 to 20 of 40 of the motion, lower at (0.000, 0.000, 1.000) mm"
    )


def test_a_press_with_too_long_a_step_comes_out_right_by_retrying(monkeypatch: pytest.MonkeyPatch) -> None:
    def pressed() -> tuple[float, int]:
        world = PressWorld(BALL)
        retries = 0
        for _ in range(3):
            pose = world.pose("indenter")
            retries += world.move({"indenter": Pose(pose.position - [0, 0, 0.3e-3])}).retries
        return -float(world.wrench("lower")[2]), retries

    truth, none = pressed()
    monkeypatch.setattr(press, "PRESS_COURANT", 1.2)
    found, some = pressed()
    assert none == 0 and some > 0
    assert found == pytest.approx(truth, rel=0.06)


def moved(world: PressWorld, gradient: np.ndarray) -> None:
    """Gives all of the gel one deformation gradient (3, 3)."""
    u = world.arrays()["gel_displacement"]
    rest = np.stack(np.meshgrid(*[np.arange(n) for n in u.shape[1:4]], indexing="ij"), axis=-1)
    u[...] = rest @ (gradient - np.eye(3)).T


@pytest.mark.parametrize(
    ("gradient", "share"),
    [
        (np.diag([1.0, 1.0, 1.0]), 1.0),
        (np.diag([1.0, 1.0, 0.5]), 0.5),
        (np.diag([0.35, 1.0, 1.5]), 0.35),
        (Rotation.from_rotvec([0.9, 0.9, 0.9]).as_matrix(), 1.0),  # turned so far that edges along x seem 0.4 long
        (Rotation.from_rotvec([0.0, 2.0, 0.0]).as_matrix() @ np.diag([1.0, 0.3, 1.0]), 0.3),
    ],
)
def test_the_step_is_measured_against_the_most_squeezed_element(gradient: np.ndarray, share: float) -> None:
    world = PressWorld(BALL)
    world.move({})
    moved(world, gradient)
    courant = world._courant()
    exact = PRESS_COURANT / share
    if exact > MAX_COURANT:
        assert courant == pytest.approx(exact, rel=1e-4)
    else:
        assert exact - 1e-4 <= courant <= MAX_COURANT


def test_most_compressed_element_is_shortest_at_any_volume() -> None:
    rest = np.stack(np.meshgrid(*[np.arange(5)] * 3, indexing="ij"), axis=-1)
    flat, small = (rest * (np.array(stretch) - 1.0) for stretch in ((0.3, 2.0, 2.0), (0.6, 0.6, 0.6)))
    for displacement, gel in (([flat, small], "lower"), ([small, flat], "upper")):
        state = {"gel_displacement": np.array(displacement)}
        assert f"of the {gel} gel" in diagnosis.describe_worst_place(
            "element length", state, state, [(4e-3, 4e-3, 4e-3)] * 2
        )


def test_unstable_step_for_compressed_elements_is_halved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Though nothing blows up, as is seen without the limit."""
    monkeypatch.setattr(press, "PRESS_COURANT", 0.8)
    world = PressWorld(BALL.model_copy(update={"settling": Settling(mach=0.1)}))
    clear = world.snapshot()

    def pressed() -> list[MoveStats]:
        world.restore(clear)
        ways = [{"indenter": Pose(np.array([0, 0, 4e-3 - depth]))} for depth in (0.27e-3, 0.54e-3, 0.8e-3)]
        return [world.move(way) for way in ways]

    with monkeypatch.context() as patch:
        patch.setattr(health, "MAX_COURANT", np.inf)
        assert all(stats.residual <= 1e-2 and stats.retries == 0 for stats in pressed())
    last = pressed()[-1]
    assert last.retries == 1 and last.time_step == pytest.approx(0.4e-3) and 0.4 < last.courant < MAX_COURANT


def test_motion_reports_step_damping_and_courant_number() -> None:
    world = PressWorld(BALL)
    pose = world.pose("indenter")
    stats = world.move({"indenter": Pose(pose.position - [0, 0, 0.5e-3])})
    assert stats.time_step == pytest.approx(0.4e-3) and stats.damping == pytest.approx(0.5)
    assert 0.4 < stats.courant < 0.6 and stats.retries == 0
    stats = world.move({"indenter": pose}, duration=1e-3)
    assert stats.damping == 0.0 and stats.time_step == pytest.approx(0.4e-3, rel=0.05)

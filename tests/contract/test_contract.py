"""One suite over every kind of rig: the same keys, shapes, types, units, ranges and times, whatever stands behind.

A new kind of rig is one more line in RIGS: a function from a folder for its files to an open rig. LIVE rigs go by the
wall clock: their times, numbers of frames and last digits are not the same twice.

Real hardware: TACSIM_CONTRACT_RIG=FILE adds the rig of that file. Its arms move: they retreat, approach, and make steps
of 10 µm, and a person is asked first.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from robot.deploy.control_loop import EpisodeSetup, run_episode
from robot.fixtures import rig_addresses
from robot.open import RIG_ATTACHMENT, open_rig
from tacsim.config import load_rig
from tacsim.control import contact_signal
from tacsim.interface import Action, EndOfEpisode, Observation, Pose, RigSpec
from tacsim.limits import ActionError
from tacsim.record.writer import Recorder
from tacsim.rig import Rig
from tacsim.tasks import make_task
from tacsim.tasks.squeeze import Grip

STEPS = 3
PERIOD = 0.1  # of every rig here [s]
GRID, SCALE = 32, 2  # cells of the canonical grid each way, image pixels a cell
# A small scene: what is tested is the contract, not the physics.
SMALL = [
    f"canonical.rows={GRID}",
    f"canonical.columns={GRID}",
    "canonical.pitch=0.5 mm",
    "scene.body.geometry.size=[4 mm, 4 mm, 4 mm]",
    "scene.gel.size=[8 mm, 8 mm, 2 mm]",
]
SIZE = {"width": 80, "height": 60}
PICTURE = [
    f"sensors.{name}.model.geometry.{key}={value}"
    for name in ("lower", "upper")
    for key, value in (*SIZE.items(), ("pixel_pitch", "0.1 mm"))
]


def open_sim(folder: Path) -> Rig:
    return open_rig("sim", overrides=[*SMALL, *PICTURE])


def open_episode(folder: Path) -> Rig:
    """A replay of an episode that the simulation recorded."""
    path = folder / "episode.mcap"
    loaded = load_rig("sim", overrides=[*SMALL, *PICTURE, "task.goal=3 mm"])
    assert loaded.config.task is not None
    task = make_task(loaded.config.task)
    recorders: list[Recorder] = []
    with open_rig(loaded) as rig:
        setup = EpisodeSetup("scripted", 0, {RIG_ATTACHMENT: loaded.text.encode()})
        run_episode(
            rig,
            task.scripted(),
            task,
            STEPS + 1,
            setup=setup,
            recorder=lambda meta: recorders.append(Recorder(path, meta)) or recorders[0],  # type: ignore[func-returns-value]
        )
    recorders[0].close()
    return open_rig(write_replay(folder, {"lower": path, "upper": path}, {"lower": path, "upper": path}))


def open_pictures(folder: Path) -> Rig:
    """A replay of a folder of pictures with a gripper's record beside it."""
    import cv2

    pictures = folder / "pictures"
    pictures.mkdir()
    random = np.random.default_rng(0)
    calm = random.integers(90, 110, (48, 64, 3), dtype=np.uint8)
    for k in range(STEPS + 2):
        cv2.imwrite(str(pictures / f"{k}.png"), cv2.add(calm, np.full_like(calm, 10 * k)))
    rows = "".join(f"{k},{0.1 * k},{0.05 - 0.001 * k}\n" for k in range(STEPS + 2))
    (folder / "force.csv").write_text("frame,force_N,gripper_width_m\n" + rows)
    return open_rig(write_replay(folder, {"finger": pictures}, {"gripper": folder / "force.csv"}))


def write_replay(folder: Path, sensors: dict[str, Path], arms: dict[str, Path]) -> Path:
    """A rig file that replays these recordings; the k-th arm carries the k-th sensor."""
    lines = ["name: replay", "clock: replay", f"canonical: {{rows: {GRID}, columns: {GRID}, pitch: 0.5 mm}}", "arms:"]
    lines += [f"  {name}: {{driver: replay, source: '{path}'}}" for name, path in arms.items()]
    lines.append("sensors:")
    for (name, path), arm in zip(sensors.items(), arms, strict=True):
        lines.append(f"  {name}: {{driver: replay, source: '{path}', arm: {arm}, fps: {1 / PERIOD}}}")
    file = folder / "replay.yaml"
    file.write_text("\n".join(lines) + "\n")
    return file


def open_mock(folder: Path) -> Rig:
    """The true drivers, over real sockets, to mock arms and cameras before the simulator."""
    if find_spec("rtde_control") is None:
        pytest.skip("ur_rtde has no wheel for this Python and machine")
    size = [f"sensors.{name}.{side}={pixels}" for name in ("lower", "upper") for side, pixels in SIZE.items()]
    return open_rig("mock", overrides=[*SMALL, *PICTURE, *size, *rig_addresses()])


def open_hardware(folder: Path) -> Rig:
    def ask(question: str) -> bool:
        return input(f"{question} [yes/no] ") == "yes"

    return open_rig(os.environ["TACSIM_CONTRACT_RIG"], confirm=ask)


RIGS: dict[str, Callable[[Path], Rig]] = {
    "sim": open_sim,
    "mock": open_mock,
    "replay of an episode": open_episode,
    "replay of pictures": open_pictures,
}
LIVE = {"mock", "hardware"}
if "TACSIM_CONTRACT_RIG" in os.environ:
    RIGS["hardware"] = open_hardware
PATIENCE = 2.0  # a live rig on a busy machine may be so late [s]


@pytest.fixture(scope="module", params=list(RIGS))
def rig(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with RIGS[request.param](tmp_path_factory.mktemp("rig")) as opened:
        yield opened


@pytest.fixture
def live(request: pytest.FixtureRequest, rig: Rig) -> bool:
    return request.node.callspec.params["rig"] in LIVE


@dataclass(frozen=True)
class Episode:
    """One episode of each rig, which most tests look at: after reset, then after each step of holding."""

    observations: list[Observation]
    images: list[dict[str, np.ndarray]]  # copies, taken as they were observed
    poses: list[dict[str, np.ndarray]]
    indices: list[list[int]]  # of the frames, step by step


@pytest.fixture(scope="module")
def episode(rig: Rig) -> Episode:
    done = Episode([], [], [], [])
    for step in range(STEPS + 1):
        observation = rig.step(Action())[0] if step else rig.reset()
        done.observations.append(observation)
        done.images.append({name: touch.image.copy() for name, touch in observation.tactile.items()})
        done.poses.append({name: arm.pose.position.copy() for name, arm in observation.arms.items()})
        done.indices.append([frame.index for frame in rig.frames.values()])
    return done


@pytest.fixture
def observations(episode: Episode) -> list[Observation]:
    return episode.observations


@pytest.mark.slow
@pytest.mark.promise(12)
def test_the_spec_says_what_is_observed(rig: Rig, observations: list[Observation]) -> None:
    assert isinstance(rig.spec, RigSpec)
    assert rig.spec.period == pytest.approx(PERIOD)
    for observation in observations:
        assert set(observation.tactile) == set(rig.spec.sensors)
        assert set(observation.arms) == set(rig.spec.arms)
        for name, spec in rig.spec.sensors.items():
            touch = observation.tactile[name]
            assert rig.frames[name].image.shape == (*spec.image_shape, 3)
            assert (touch.height is not None) == spec.height
            assert (touch.gradient is not None) == spec.height
            assert (touch.flow is not None) == spec.flow
            assert spec.arm is None or spec.arm in rig.spec.arms


@pytest.mark.promise(12)
def test_touch_has_the_canonical_shapes_types_and_ranges(rig: Rig, observations: list[Observation]) -> None:
    for touch in (touch for observation in observations for touch in observation.tactile.values()):
        assert touch.image.shape == (GRID * SCALE, GRID * SCALE, 3)
        assert touch.image.dtype == np.uint8
        for mask in (touch.contact, touch.valid):
            assert mask.shape == (GRID, GRID)
            assert mask.dtype == np.bool_
        assert touch.valid.any()
        assert not (touch.contact & ~touch.valid).any()
        assert 0.0 <= contact_signal(touch) <= 1.0
        if touch.height is not None and touch.gradient is not None:
            assert touch.height.shape == (GRID, GRID)
            assert touch.height.dtype == np.float32
            assert touch.gradient.shape == (GRID, GRID, 2)
            assert touch.gradient.dtype == np.float32
            assert float(np.abs(touch.height).max()) < 2e-3  # metres, not millimetres: less than the gel is thick
            assert np.isfinite(touch.gradient).all()


@pytest.mark.promise(12)
def test_arms_speak_si_in_world_and_sensor_axes(rig: Rig, observations: list[Observation]) -> None:
    for arm in (arm for observation in observations for arm in observation.arms.values()):
        assert isinstance(arm.pose, Pose)
        assert float(np.abs(arm.pose.position).max()) < 1.0
        for vector in (arm.twist, arm.wrench):
            assert vector.shape == (6,)
            assert vector.dtype == np.float64
            assert np.isfinite(vector).all()
        assert arm.wrench[2] <= 1e-6  # the object pushes the sensor back, against its own z
        assert arm.joints is None or arm.joints.dtype == np.float64


@pytest.mark.promise(12)
def test_times_run_on_one_clock(rig: Rig, live: bool, observations: list[Observation]) -> None:
    """From zero, a period a step; on a live rig that of the wall, which only grows."""
    times = [observation.time for observation in observations]
    if live:
        assert (np.diff(times) > 0).all()
    else:
        assert times == pytest.approx([PERIOD * k for k in range(STEPS + 1)])
    oldest = PATIENCE if live else PERIOD
    for observation in observations:
        for touch in observation.tactile.values():
            assert touch.age == pytest.approx(observation.time - touch.time)
            assert 0.0 <= touch.age < oldest
        for arm in observation.arms.values():
            assert 0.0 <= observation.time - arm.time < oldest


def test_arms_are_told_of_the_moment_of_exposure(rig: Rig, observations: list[Observation]) -> None:
    for observation in observations:
        for name, touch in observation.tactile.items():
            arm = rig.spec.sensors[name].arm
            if arm is not None and arm in observation.arms:
                assert abs(observation.arms[arm].time - touch.time) < 20e-3


def test_frame_numbers_have_no_gap(live: bool, episode: Episode) -> None:
    """A live camera goes on by itself: several frames between two steps, or, on a busy machine, none yet."""
    steps = np.diff(episode.indices, axis=0)
    if live:
        assert np.all(steps >= 0)
        assert np.all(np.sum(steps, axis=0) > 0)
    else:
        assert np.all(steps == 1)


def test_references_are_without_contact(rig: Rig, episode: Episode) -> None:
    assert set(rig.references) == set(rig.spec.sensors)
    for name, frame in rig.references.items():
        assert frame.image.shape == rig.frames[name].image.shape


@pytest.mark.slow
def test_a_second_episode_is_the_first_again(rig: Rig, live: bool, observations: list[Observation]) -> None:
    """To the bit; on a live rig as far as an arm comes twice to the same place."""
    again = [rig.reset(), *(rig.step(Action())[0] for _ in range(STEPS))]
    for one, other in zip(observations, again, strict=True):
        for name, touch in one.tactile.items():
            if live:
                assert np.abs(touch.image.astype(int) - other.tactile[name].image).mean() < 1.0
            else:
                assert one.time == other.time
                assert np.array_equal(touch.image, other.tactile[name].image)
        for name, arm in one.arms.items():
            if live:
                assert other.arms[name].pose.position == pytest.approx(arm.pose.position, abs=20e-6)
                assert other.arms[name].wrench[2] == pytest.approx(arm.wrench[2], rel=0.1, abs=0.02)
            else:
                assert np.array_equal(arm.wrench, other.arms[name].wrench)


def test_what_was_observed_does_not_change_later(episode: Episode) -> None:
    for observation, images, poses in zip(episode.observations, episode.images, episode.poses, strict=True):
        assert all(np.array_equal(observation.tactile[name].image, image) for name, image in images.items())
        assert all(np.array_equal(observation.arms[name].pose.position, place) for name, place in poses.items())


@pytest.mark.slow
def test_what_was_sent_is_told_for_every_arm(rig: Rig) -> None:
    observation = rig.reset()
    targets = {
        name: Pose(arm.pose.position + [0, 0, 1e-5], arm.pose.quaternion) for name, arm in observation.arms.items()
    }
    observation, sent = rig.step(Action(targets))
    assert set(sent) == set(rig.spec.arms)
    for name, pose in sent.items():
        if pose is not None:  # executed: the arm is there at the end of the period
            assert observation.arms[name].pose.position == pytest.approx(pose.position, abs=5e-6)


def test_an_unknown_arm_is_refused(rig: Rig, episode: Episode) -> None:
    with pytest.raises(ActionError, match="'third_hand'"):
        rig.step(Action({"third_hand": Pose()}))


def test_truth_is_there_as_the_spec_says(rig: Rig, episode: Episode) -> None:
    truth = rig.truth()
    assert (truth is not None) == rig.spec.truth
    if truth is not None:
        assert 1e-3 < truth.height < 0.1
        assert truth.points.shape == (len(truth.points), 3)
        assert set(truth.poses) == set(rig.spec.sensors)


@pytest.mark.slow
@pytest.mark.promise(12)
def test_an_image_policy_runs_and_every_step_is_recorded(rig: Rig) -> None:
    episode = run_episode(rig, Grip(rig.spec), None, STEPS)
    assert len(episode.steps) == STEPS + 1
    for step in episode.steps:
        assert set(step.frames) == set(rig.spec.sensors)
        assert all(math.isfinite(value) for value in step.info.values())
        assert {f"contact_signal_{name}" for name in rig.spec.sensors} <= set(step.info)


@pytest.mark.slow
def test_it_ends_or_goes_on_but_never_hangs(rig: Rig) -> None:
    """Recordings end with EndOfEpisode; what is live takes any number of steps."""
    rig.reset()
    try:
        for _ in range(3 * STEPS):
            rig.step(Action())
    except EndOfEpisode:
        assert not rig.spec.truth
    rig.reset()  # and it can begin again

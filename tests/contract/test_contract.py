"""One suite over every kind of rig: the same keys, shapes, types, units, ranges and times, whatever stands behind.

A new kind of rig is one more line in RIGS: a function from a folder for its files to an open rig.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from robot.deploy import EpisodeFacts, run_episode
from robot.open import RIG_ATTACHMENT, open_rig
from tacsim.config import load_rig
from tacsim.interface import Action, EndOfEpisode, Observation, Pose, RigSpec
from tacsim.limits import ActionError
from tacsim.record.writer import Recorder
from tacsim.rig import Rig
from tacsim.tasks import make_task
from tacsim.tasks.grip import Grip
from tacsim.touch import contact_signal

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
PICTURE = [
    f"sensors.{name}.model.geometry.{key}={value}"
    for name in ("lower", "upper")
    for key, value in (("width", 80), ("height", 60), ("pixel_pitch", "0.1 mm"))
]


def open_sim(folder: Path) -> Rig:
    return open_rig("sim", overrides=[*SMALL, *PICTURE])


def open_episode(folder: Path) -> Rig:
    """A replay of an episode that the simulation recorded."""
    path = folder / "episode.mcap"
    loaded = load_rig("sim", overrides=[*SMALL, *PICTURE])
    assert loaded.facts.task is not None
    task = make_task(loaded.facts.task)
    recorders: list[Recorder] = []
    with open_rig(loaded) as rig:
        facts = EpisodeFacts("scripted", 0, {RIG_ATTACHMENT: loaded.text.encode()})
        run_episode(
            rig,
            task.scripted(),
            task,
            STEPS + 1,
            facts=facts,
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


RIGS: dict[str, Callable[[Path], Rig]] = {
    "sim": open_sim,
    "replay of an episode": open_episode,
    "replay of pictures": open_pictures,
}


@pytest.fixture(scope="module", params=list(RIGS))
def rig(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with RIGS[request.param](tmp_path_factory.mktemp("rig")) as opened:
        yield opened


@pytest.fixture
def observations(rig: Rig) -> list[Observation]:
    """Those of an episode: after reset, then after each step of holding."""
    return [rig.reset(), *(rig.step(Action())[0] for _ in range(STEPS))]


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


def test_arms_speak_si_in_world_and_sensor_axes(rig: Rig, observations: list[Observation]) -> None:
    for arm in (arm for observation in observations for arm in observation.arms.values()):
        assert isinstance(arm.pose, Pose)
        assert float(np.abs(arm.pose.position).max()) < 1.0
        for vector in (arm.twist, arm.wrench):
            assert vector.shape == (6,)
            assert vector.dtype == np.float64
            assert np.isfinite(vector).all()
        assert arm.wrench[2] <= 0.0  # the object pushes the sensor back, against its own z
        assert arm.joints is None or arm.joints.dtype == np.float64


def test_times_run_on_one_clock_from_zero(rig: Rig, observations: list[Observation]) -> None:
    assert [observation.time for observation in observations] == pytest.approx([PERIOD * k for k in range(STEPS + 1)])
    for observation in observations:
        for touch in observation.tactile.values():
            assert touch.age == pytest.approx(observation.time - touch.time)
            assert 0.0 <= touch.age < PERIOD
        for arm in observation.arms.values():
            assert 0.0 <= observation.time - arm.time < PERIOD


def test_frame_numbers_have_no_gap(rig: Rig) -> None:
    rig.reset()
    numbers = []
    for _ in range(STEPS):
        rig.step(Action())
        numbers.append([frame.index for frame in rig.frames.values()])
    assert np.all(np.diff(numbers, axis=0) == 1)


def test_references_are_without_contact(rig: Rig) -> None:
    rig.reset()
    assert set(rig.references) == set(rig.spec.sensors)
    for name, frame in rig.references.items():
        assert frame.image.shape == rig.frames[name].image.shape


def test_a_second_episode_is_the_first_again(rig: Rig, observations: list[Observation]) -> None:
    again = [rig.reset(), *(rig.step(Action())[0] for _ in range(STEPS))]
    for one, other in zip(observations, again, strict=True):
        assert one.time == other.time
        for name, touch in one.tactile.items():
            assert np.array_equal(touch.image, other.tactile[name].image)
        for name, arm in one.arms.items():
            assert np.array_equal(arm.wrench, other.arms[name].wrench)


def test_what_was_observed_does_not_change_later(rig: Rig) -> None:
    first = rig.reset()
    before = {name: touch.image.copy() for name, touch in first.tactile.items()}
    poses = {name: arm.pose.position.copy() for name, arm in first.arms.items()}
    rig.step(Action())
    assert all(np.array_equal(first.tactile[name].image, image) for name, image in before.items())
    assert all(np.array_equal(first.arms[name].pose.position, place) for name, place in poses.items())


def test_what_was_sent_is_told_for_every_arm(rig: Rig) -> None:
    observation = rig.reset()
    targets = {
        name: Pose(arm.pose.position + [0, 0, 1e-5], arm.pose.quaternion) for name, arm in observation.arms.items()
    }
    observation, sent = rig.step(Action(targets))
    assert set(sent) == set(rig.spec.arms)
    for name, pose in sent.items():
        if pose is not None:  # executed: the arm is there at the end of the period
            assert observation.arms[name].pose.position == pytest.approx(pose.position, abs=1e-6)


def test_an_unknown_arm_is_refused(rig: Rig) -> None:
    rig.reset()
    with pytest.raises(ActionError, match="'third_hand'"):
        rig.step(Action({"third_hand": Pose()}))


def test_truth_is_there_as_the_spec_says(rig: Rig) -> None:
    rig.reset()
    truth = rig.truth()
    assert (truth is not None) == rig.spec.truth
    if truth is not None:
        assert 1e-3 < truth.height < 0.1
        assert truth.points.shape == (len(truth.points), 3)
        assert set(truth.poses) == set(rig.spec.sensors)


def test_an_image_policy_runs_and_every_step_is_recorded(rig: Rig) -> None:
    episode = run_episode(rig, Grip(rig.spec), None, STEPS)
    assert len(episode.steps) == STEPS + 1
    for step in episode.steps:
        assert set(step.frames) == set(rig.spec.sensors)
        assert all(math.isfinite(value) for value in step.info.values())
        assert {f"contact_signal_{name}" for name in rig.spec.sensors} <= set(step.info)


def test_it_ends_or_goes_on_but_never_hangs(rig: Rig) -> None:
    """Recordings end with EndOfEpisode; what is live takes any number of steps."""
    rig.reset()
    try:
        for _ in range(3 * STEPS):
            rig.step(Action())
    except EndOfEpisode:
        assert not rig.spec.truth
    rig.reset()  # and it can begin again

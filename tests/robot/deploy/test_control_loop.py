"""The control loop: the requested number of steps, all of them stored in every case; and policies by name."""

from __future__ import annotations

import gc
import sys
import time
import weakref
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from robot.deploy.control_loop import EpisodeFailed, EpisodeSetup, run_episode, versions
from robot.deploy.policy import PolicyNotFound, load_policy
from robot.deploy.python_policy import FunctionPolicy
from robot.serve.operated_policy import OperatedPolicy
from tacsim.interface import (
    Action,
    ArmState,
    EndOfEpisode,
    IncompatibleRig,
    Needs,
    Observation,
    Pose,
    SensorSpec,
    TactileFrame,
    TactileObservation,
    Truth,
)
from tacsim.models.task import SqueezeConfig
from tacsim.record.episode import EpisodeMeta, Step
from tacsim.record.images import reference_image
from tacsim.record.reader import read_episode
from tacsim.record.schemas import Step as StepMessage
from tacsim.record.writer import Recorder as FileRecorder
from tacsim.rig import Rig
from tacsim.tasks import make_task
from tacsim.tasks.squeeze import Grip, ScriptedSqueeze


class Hand:
    """Sensor, arm, clock, normaliser and start of a rig that closes on a body of 10 mm by what it is commanded."""

    period = 0.1

    def __init__(self, frames: int = 1000) -> None:
        self.spec = SensorSpec((8, 8), height=False, flow=False, arm="lower")
        self.frames, self.ticks, self.stops, self.resets = frames, 0, 0, 0
        self.pose = Pose()

    def read(self, timeout: float) -> TactileFrame:
        if self.ticks >= self.frames:
            raise EndOfEpisode(f"{self.frames} frames")
        return TactileFrame(np.full((8, 8, 3), self.ticks, np.uint8), time=self.now(), index=self.ticks)

    def state(self, at: float | None = None) -> ArmState:
        return ArmState(self.pose, np.zeros(6), np.zeros(6), None, self.now())

    def command(self, target: Pose | None) -> Pose | None:
        self.pose = target or self.pose
        return target

    def now(self) -> float:
        return self.ticks * self.period

    def tick(self) -> None:
        self.ticks += 1

    def clear(self, seed: int) -> Mapping[str, TactileFrame]:
        self.ticks, self.resets = 0, self.resets + 1
        return {"lower": TactileFrame(np.full((8, 8, 3), 200 + seed, np.uint8), time=0.0, index=0)}

    def touch(self) -> None:
        pass

    def diagnostics(self) -> dict[str, float]:
        return {"stale": 0.0}

    def take_reference(self, frame: TactileFrame) -> None:
        pass

    def __call__(self, frame: TactileFrame, now: float) -> TactileObservation:
        mask = np.ones((4, 4), bool)
        return TactileObservation(
            frame.image, gradient=None, height=None, contact=mask, valid=mask, flow=None, time=frame.time, age=0.0
        )

    def truth(self) -> Truth:
        height = 10e-3 - self.pose.position[2]
        return Truth(height, np.array([1e-3, 0.0, height / 2]), np.zeros((1, 3), np.float32), {})

    def stop(self) -> None:
        self.stops += 1

    recover = close = touch


def make_rig(hand: Hand, truth: bool = True) -> Rig:
    return Rig(
        name="hand",
        sensors={"lower": hand},
        arms={"lower": hand, "upper": hand},
        clock=hand,
        normalisers={"lower": hand},
        reset=hand,
        truth=hand.truth if truth else None,
        diagnostics=lambda: {"residual": 0.25},
    )


def lift(observation: Observation) -> Action:
    """One millimetre up a step."""
    return Action({"lower": Pose(observation.arms["lower"].pose.position + [0, 0, 1e-3])})


TASK = make_task(SqueezeConfig(kind="squeeze", goal=7e-3))


class Recorder:
    def __init__(self, meta: EpisodeMeta) -> None:
        self.meta, self.steps = meta, list[Step]()
        self.error: Exception | None = None

    def write(self, step: Step) -> bool:
        self.steps.append(step)
        return len(self.steps) != 2  # the second one is dropped

    def flush(self) -> bool:
        return True


def test_run_episode_has_requested_steps_after_reset() -> None:
    hand = Hand()
    episode = run_episode(make_rig(hand), FunctionPolicy(lift), TASK, 4)
    assert [step.index for step in episode.steps] == [0, 1, 2, 3, 4]
    assert hand.ticks == 4
    assert hand.stops > 0
    first, last = episode.steps[0], episode.steps[-1]
    assert first.action is None
    assert first.distance == pytest.approx(3e-3)
    assert last.action is not None
    assert last.sent["lower"] is last.action.tool["lower"]
    assert last.time == pytest.approx(0.4)
    assert [step.distance for step in episode.steps] == pytest.approx([3e-3, 2e-3, 1e-3, 0, 1e-3], abs=1e-12)
    assert last.reward == pytest.approx(-1.0)
    assert last.info["body_height"] == pytest.approx(6e-3)
    assert last.info["residual"] == 0.25
    assert last.info["contact_signal_lower"] == pytest.approx((128 - 4) / 128)
    assert last.frames["lower"].image.max() == 4
    assert last.seconds > 0
    assert run_episode(make_rig(Hand()), FunctionPolicy(lift), TASK, 0).steps[-1].index == 0


class GoalRecorder:
    """A policy that gets a goal, and records its calls."""

    needs = Needs()

    def __init__(self) -> None:
        self.calls: list[object] = []

    def set_goal(self, goal: float) -> None:
        self.calls.append(goal)

    def reset(self) -> None:
        self.calls.append("reset")

    def __call__(self, observation: Observation) -> Action:
        return lift(observation)


def test_policy_gets_the_goal_before_its_reset() -> None:
    """As in the benchmark; also one that an operator may pause."""
    recorder, operated = GoalRecorder(), GoalRecorder()
    run_episode(make_rig(Hand()), recorder, TASK, 1)
    assert recorder.calls == [TASK.goal, "reset"]
    inner = OperatedPolicy(operated, "policy", 1e-3, 0.1, None, is_live=False)
    run_episode(make_rig(Hand()), inner, TASK, 1)
    assert operated.calls == [TASK.goal, "reset"]
    alone = GoalRecorder()
    run_episode(make_rig(Hand()), alone, None, 1)
    assert alone.calls == ["reset"]


def test_run_episode_failed_recording_stops_arms() -> None:
    class FullDisk(Recorder):
        def write(self, step: Step) -> bool:
            if len(self.steps) == 2:
                self.error = OSError(28, "No space left on device")
                return False
            self.steps.append(step)
            return True

    hand = Hand()
    with pytest.raises(EpisodeFailed, match=r"after 2 of 40 steps: RecordingFailed: .* No space") as failed:
        run_episode(make_rig(hand), FunctionPolicy(lift), TASK, 40, recorder=FullDisk)
    assert len(failed.value.episode.steps) == 2  # what is recorded
    assert hand.stops > 0


def test_run_episode_records_steps_meta_and_references() -> None:
    recorders: list[Recorder] = []

    def open_recorder(meta: EpisodeMeta) -> Recorder:
        recorders.append(Recorder(meta))
        return recorders[-1]

    shown: list[int] = []
    episode = run_episode(
        make_rig(Hand()),
        FunctionPolicy(lift),
        TASK,
        3,
        setup=EpisodeSetup("lift", 7, {"rig.yaml": b"name: hand"}),
        recorder=open_recorder,
        on_step=lambda step: shown.append(step.index),
    )
    (recorder,) = recorders
    assert recorder.steps == episode.steps
    assert shown == [0, 1, 2, 3]
    assert episode.dropped == 1
    meta = recorder.meta
    assert (meta.rig, meta.task, meta.policy, meta.seed, meta.goal) == ("hand", "squeeze", "lift", 7, 7e-3)
    assert meta.attachments["rig.yaml"] == b"name: hand"
    reference = reference_image(meta.attachments, "lower")
    assert reference is not None
    assert reference.max() == reference.min() == 207
    assert meta.versions == versions()
    assert {"python", "numpy"} <= set(meta.versions)


@pytest.mark.slow
def test_run_episode_with_recorder_keeps_no_picture_in_memory(tmp_path: Path) -> None:
    """Of 200 steps only those that still wait for the disk may be there; each is read again on access."""
    pictures: list[weakref.ref[Any]] = []
    most = 0

    def look(step: Step) -> None:
        nonlocal most
        pictures.append(weakref.ref(step.frames["lower"].image))
        most = max(most, sum(picture() is not None for picture in pictures))

    with ExitStack() as stack:
        episode = run_episode(
            make_rig(Hand()),
            FunctionPolicy(lift),
            TASK,
            200,
            recorder=lambda meta: stack.enter_context(FileRecorder(tmp_path / "e.mcap", meta, capacity=8)),
            on_step=look,
        )
        assert episode.dropped == 0 or len(episode.steps) + episode.dropped == 201
    assert most <= 8 + 4  # in the queue, in work, in the rig, at hand
    gc.collect()
    assert sum(picture() is not None for picture in pictures) <= 1  # the rig's last one
    assert episode.steps[-1].index == 200 or episode.dropped
    assert episode.steps[-1].frames["lower"].image.max() == episode.steps[-1].index


def test_run_episode_recording_has_date_and_exact_times(tmp_path: Path) -> None:
    before = time.time_ns()
    with ExitStack() as stack:
        run_episode(
            make_rig(Hand()),
            FunctionPolicy(lift),
            TASK,
            3,
            recorder=lambda meta: stack.enter_context(FileRecorder(tmp_path / "e.mcap", meta)),
        )
    after = time.time_ns()
    read = read_episode(tmp_path / "e.mcap")
    assert [step.time for step in read.steps] == [k * Hand.period for k in range(4)]  # exact, on the rig's clock
    assert read.meta.started is not None and read.meta.started.utcoffset() is not None
    assert before / 1e9 - 1e-3 <= read.meta.started.timestamp() <= after / 1e9 + 1e-3
    assert before <= read.meta.wall_offset <= after  # the rig's clock stood at 0
    with (tmp_path / "e.mcap").open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(topics=["/step", "/lower/image"]):
            k = StepMessage.FromString(message.data).index if channel.topic == "/step" else None
            if k is not None:
                assert message.log_time == message.publish_time == read.meta.wall_offset + k * 10**8
            assert before <= message.log_time <= after + 3 * 10**8
            assert before <= message.publish_time <= after + 3 * 10**8


def test_run_episode_without_truth_is_not_judged() -> None:
    episode = run_episode(make_rig(Hand(), truth=False), FunctionPolicy(lift), None, 2)
    assert all(step.reward is None and step.distance is None for step in episode.steps)
    assert "body_height" not in episode.steps[0].info


def test_run_episode_missing_needs_raise_before_motion() -> None:
    hand = Hand()
    with pytest.raises(IncompatibleRig, match=r"task 'squeeze' .judged by touch.*lacks sensor 'upper'; surface h"):
        run_episode(make_rig(hand, truth=False), FunctionPolicy(lift), TASK, 2)
    with pytest.raises(IncompatibleRig, match="policy 'scripted'"):
        run_episode(make_rig(hand), TASK.scripted(), TASK, 2, setup=EpisodeSetup("scripted"))
    assert hand.resets == 0


def test_run_episode_end_of_replay_ends_cleanly() -> None:
    episode = run_episode(make_rig(Hand(frames=3)), FunctionPolicy(lift), TASK, 100)
    assert [step.index for step in episode.steps] == [0, 1, 2]


def test_run_episode_stop_ends_after_step() -> None:
    hand = Hand()
    episode = run_episode(make_rig(hand), FunctionPolicy(lift), TASK, 100, stop=lambda: hand.ticks >= 2)
    assert len(episode.steps) == 3
    assert hand.stops > 0


def test_run_episode_ctrl_c_keeps_steps() -> None:
    hand = Hand()

    def act(observation: Observation) -> Action:
        if hand.ticks == 2:
            raise KeyboardInterrupt
        return lift(observation)

    assert len(run_episode(make_rig(hand), FunctionPolicy(act), TASK, 100).steps) == 3
    assert hand.stops > 0


def test_run_episode_policy_error_stops_arms_and_keeps_steps() -> None:
    hand = Hand()

    def act(observation: Observation) -> Action:
        if hand.ticks == 2:
            raise ZeroDivisionError("no grip")
        return lift(observation)

    with pytest.raises(
        EpisodeFailed, match=r"ended after 2 of 100 steps: policy .* raised ZeroDivisionError: no grip; the arms hold"
    ) as caught:
        run_episode(make_rig(hand), FunctionPolicy(act), TASK, 100)
    assert len(caught.value.episode.steps) == 3
    assert isinstance(caught.value.__cause__, ZeroDivisionError)
    assert hand.stops > 0


def test_run_episode_policy_exit_ends_episode() -> None:
    def act(observation: Observation) -> Action:
        sys.exit(7)

    with pytest.raises(EpisodeFailed, match=r"ended after 0 of 5 steps: policy .* raised SystemExit: 7"):
        run_episode(make_rig(Hand()), FunctionPolicy(act), TASK, 5)


def test_run_episode_negative_steps_raise() -> None:
    with pytest.raises(ValueError, match="-1"):
        run_episode(make_rig(Hand()), FunctionPolicy(lift), TASK, -1)


MODULE = """
from tacsim.interface import Action, Needs

def hold(observation):
    return Action()

class Counting:
    needs = Needs(height=True)
    def reset(self): self.count = 0
    def __call__(self, observation): return Action()

class Demanding(Counting):
    def __init__(self, force): pass

class Needless(Counting):
    needs = None

ready = Counting()
number = 3
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_policies.py").write_text(MODULE)
    (tmp_path / "broken_policies.py").write_text("import no_such_package\n")
    (tmp_path / "failing_policies.py").write_text("1 / 0\n")
    (tmp_path / "ending_policies.py").write_text("import sys\nsys.exit(3)\n")
    monkeypatch.syspath_prepend(str(tmp_path))


def load(name: str, task: Any = TASK) -> Any:
    return load_policy(name, task, make_rig(Hand()).spec)


@pytest.mark.usefixtures("module")
def test_load_policy_known_names_return_policies() -> None:
    assert isinstance(load("scripted"), ScriptedSqueeze)
    assert isinstance(load("grip"), Grip)
    assert load("my_policies:hold").needs == Needs()
    assert load("my_policies:hold")(None).tool == {}
    assert load("my_policies:Counting").needs == Needs(height=True)
    import my_policies  # type: ignore[import-not-found]

    assert load("my_policies:ready") is my_policies.ready


@pytest.mark.usefixtures("module")
@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "scriptd",
            "no policy 'scriptd'; allowed: 'scripted', 'grip', 'learned', 'path/to/file.onnx', 'path/to/file.csv', or ",
        ),
        ("my_policies:", "must have the form"),
        ("no_policies:hold", "no module 'no_policies'"),
        ("my_policies:absent", "'my_policies' has no 'absent'"),
        ("my_policies:number", "is a int: not a policy and not a function"),
        ("my_policies:Demanding", "cannot be created without arguments"),
        ("broken_policies:hold", "itself imports 'no_such_package', which is missing"),
        ("failing_policies:hold", "importing 'failing_policies' failed: ZeroDivisionError"),
        ("ending_policies:hold", r"importing 'ending_policies' failed: SystemExit\(3\)"),
        ("my_policies:Needless", "its needs must be a tacsim.Needs, got NoneType"),
    ],
)
def test_load_policy_unknown_name_raises_with_reason(name: str, message: str) -> None:
    with pytest.raises(PolicyNotFound, match=message):
        load(name)


def test_load_policy_scripted_without_task_raises() -> None:
    with pytest.raises(PolicyNotFound, match="this rig has none"):
        load("scripted", task=None)

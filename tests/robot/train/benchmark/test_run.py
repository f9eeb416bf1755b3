"""Runs and verification: the same bits again, resumption, policies that raise, edited files."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import robot.train.benchmark.play as play
from robot.common.file_lock import hold_lock
from robot.train.benchmark.blind import BlindMotion, BlindWeights, start_numbers
from robot.train.benchmark.hashing import hash_document
from robot.train.benchmark.policies import BASELINES
from robot.train.benchmark.run import OtherRun, Run, run_benchmark
from robot.train.benchmark.score import NotAScore, Score, ScoreEdited, read_score, write_score
from robot.train.benchmark.verify import WrongSubject, verify_score
from tacsim.interface import Observation, Pose
from tests.robot.cli.invoked import tacsim
from tests.robot.train.benchmark.small import Raises, write_task

pytestmark = pytest.mark.slow  # simulations
RAISES = "tests.robot.train.benchmark.small:Raises"


@pytest.fixture(scope="module")
def task(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_task(tmp_path_factory.mktemp("task"), episodes=5)


def run(
    task: str, folder: Path, *policies: str, environments: int = 2, split: str = "test"
) -> list[tuple[Path, Score]]:
    return run_benchmark(Run(task, policies, (split,), "quick", folder, environments))


@pytest.fixture(scope="module")
def played(task: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Score]:
    return run(task, tmp_path_factory.mktemp("played"), "analytic")[0]


def test_two_runs_have_the_same_bits(task: str, played: tuple[Path, Score], tmp_path: Path) -> None:
    """Whatever number of episodes moves together."""
    ((_, again), (_, other)) = run(task, tmp_path, "analytic", "random", environments=5)
    assert again.result_sha256 == played[1].result_sha256
    assert other.result_sha256 != again.result_sha256
    assert [each.episode for each in again.episodes] == [0, 1, 2, 3, 4]
    assert len({each.distance for each in again.episodes}) == 5
    assert all(each.steps == 3 and each.end == "steps" for each in again.episodes)


def test_score_holds_all_hashes(played: tuple[Path, Score]) -> None:
    score = read_score(played[0])
    assert score == played[1] and score.complete and score.version == "v1"
    for key in ("policy_sha256", "task_sha256", "split_sha256", "sensors_sha256"):
        assert len(getattr(score, key)) == 64
    assert len(score.physics.motion) == len(score.physics.source) == 64
    assert score.machine.vector_width in (32, 128, 256) and score.machine.processor


def test_interrupted_run_resumes_and_plays_nothing_twice(
    task: str, played: tuple[Path, Score], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = play.SplitPlayer.play
    rounds: list[list[int]] = []

    def stopped(self: Any, policy: str, numbers: Any, *rest: Any) -> Iterator[Any]:
        for each in whole(self, policy, numbers, *rest):
            if len(rounds) == 1:
                raise KeyboardInterrupt
            rounds.append([score.episode for score in each[0]])
            yield each

    monkeypatch.setattr(play.SplitPlayer, "play", stopped)
    with pytest.raises(KeyboardInterrupt):
        run(task, tmp_path, "analytic")
    (path,) = tmp_path.rglob("*.json")
    assert [each.episode for each in read_score(path).episodes] == [0, 1] and not read_score(path).complete
    monkeypatch.undo()
    asked: list[int] = []

    def watched(self: Any, policy: str, numbers: Any, *rest: Any) -> Iterator[Any]:
        asked.extend(numbers)
        yield from whole(self, policy, numbers, *rest)

    monkeypatch.setattr(play.SplitPlayer, "play", watched)
    ((_, score),) = run(task, tmp_path, "analytic")
    assert asked == [2, 3, 4]
    assert score.complete and score.result_sha256 == played[1].result_sha256
    run(task, tmp_path, "analytic")
    assert asked == [2, 3, 4]


def test_policy_that_raises_fails_its_episode_alone(task: str, tmp_path: Path) -> None:
    Raises.count = -1
    ((_, score),) = run(task, tmp_path, RAISES, environments=1)
    ends = [each.end for each in score.episodes]
    assert ends == ["steps", "error", "steps", "steps", "error"]
    failed = score.episodes[1]
    assert failed.reason == "policy: ZeroDivisionError: a number was zero"
    assert failed.steps == 1 and not failed.success and failed.distance is not None
    assert score.complete


def test_verify_plays_a_sample_again(task: str, played: tuple[Path, Score]) -> None:
    found = verify_score(played[0], 2, task=task)
    assert found.verdict == "agrees" and len(found.checks) == 2 and not found.differences


def test_verify_refuses_an_edited_file(task: str, played: tuple[Path, Score], tmp_path: Path) -> None:
    document = json.loads(played[0].read_text(encoding="utf-8"))
    document["episodes"][1]["success"] = not document["episodes"][1]["success"]
    edited = tmp_path / "edited.json"
    edited.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(ScoreEdited, match="edited after it was written"):
        verify_score(edited, 1, task=task)
    assert tacsim("benchmark", "verify", edited, "--task", task).exit_code == 3


def test_verify_finds_numbers_that_were_sealed_again(task: str, played: tuple[Path, Score], tmp_path: Path) -> None:
    """Who edits may compute the seal again; playing again shows it."""
    better = played[1].episodes[0].model_copy(update={"distance": 0.0, "success": True})
    edited = tmp_path / "edited.json"
    write_score(edited, played[1].model_copy(update={"episodes": (better, *played[1].episodes[1:])}))
    found = verify_score(edited, None, task=task)
    assert found.verdict == "differs"
    assert [each.is_equal for each in found.checks] == [False, True, True, True, True]
    result = tacsim("benchmark", "verify", edited, "--task", task, "--all")
    assert result.exit_code == 3 and "differs: 4 of 5 episodes" in result.stdout
    assert "episode 0: numbers in the file differ" in result.stderr


def test_verify_states_what_differs_elsewhere(task: str, played: tuple[Path, Score], tmp_path: Path) -> None:
    """Of another simulator: other bits cannot be judged, equal bits are still equal."""
    score = played[1]
    elsewhere = tmp_path / "elsewhere.json"
    machine = score.machine.model_copy(update={"vector_width": 64})
    write_score(elsewhere, score.model_copy(update={"machine": machine}))
    found = verify_score(elsewhere, 1, task=task)
    assert found.verdict == "agrees" and found.differences == (
        f"vector width [bits]: 64 there, {score.machine.vector_width} here",
    )
    others = tuple(each.model_copy(update={"states": "0" * 32}) for each in score.episodes)
    write_score(elsewhere, score.model_copy(update={"machine": machine, "episodes": others}))
    result = tacsim("benchmark", "verify", elsewhere, "--task", task)
    assert result.exit_code == 4 and "vector width [bits]: 64 there" in result.stderr
    write_score(elsewhere, score.model_copy(update={"episodes": others}))
    assert tacsim("benchmark", "verify", elsewhere, "--task", task).exit_code == 3


def test_verify_refuses_another_subject(task: str, played: tuple[Path, Score], tmp_path: Path) -> None:
    other = tmp_path / "other.json"
    write_score(other, played[1].model_copy(update={"policy_sha256": hash_document("other")}))
    with pytest.raises(WrongSubject, match="policy 'analytic' is another file"):
        verify_score(other, 1, task=task)
    write_score(other, played[1].model_copy(update={"split_sha256": hash_document("other")}))
    result = tacsim("benchmark", "verify", other, "--task", task)
    assert result.exit_code == 2 and "episodes of 'small', test, are others here" in result.stderr


def test_other_files_are_no_scores(tmp_path: Path, played: tuple[Path, Score]) -> None:
    path = tmp_path / "x.json"
    path.write_text("{}", encoding="utf-8")
    with pytest.raises(NotAScore, match="no score of the benchmark v1"):
        read_score(path)
    text = played[0].read_text(encoding="utf-8")
    path.write_text(text.replace('"version": "v1"', '"version": "v0"'), encoding="utf-8")
    with pytest.raises(NotAScore, match="use the version that wrote it"):
        read_score(path)


def test_run_with_another_subject_overwrites_nothing(task: str, played: tuple[Path, Score], tmp_path: Path) -> None:
    path = tmp_path / played[0].relative_to(played[0].parents[2])
    write_score(path, played[1].model_copy(update={"task_sha256": hash_document("other")}))
    before = path.read_bytes()
    with pytest.raises(OtherRun, match="another task_sha256"):
        run(task, tmp_path, "analytic")
    assert path.read_bytes() == before


def test_score_that_another_process_writes_is_left_alone(task: str, played: tuple[Path, Score], tmp_path: Path) -> None:
    path = tmp_path / played[0].relative_to(played[0].parents[2])
    with hold_lock(path), pytest.raises(OtherRun, match="another process writes this score"):
        run(task, tmp_path, "analytic")
    assert not path.exists()


def test_missing_policy_is_refused_before_anything_is_simulated(task: str, tmp_path: Path) -> None:
    result = tacsim("benchmark", "run", task, "--policy", "none.onnx", "--out", tmp_path / "out")
    assert result.exit_code == 2 and "no such file" in result.stderr
    assert not (tmp_path / "out").exists()
    result = tacsim("benchmark", "run", task, "--policy", "blind", "--out", tmp_path / "out")
    assert result.exit_code == 2 and "fit-blind" in result.stderr


def test_unknown_policy_is_answered_by_the_names_of_the_benchmark(task: str, tmp_path: Path) -> None:
    result = tacsim("benchmark", "run", task, "--policy", "analitic", "--out", tmp_path)
    assert result.exit_code == 2 and "did you mean 'analytic'" in result.stderr
    assert all(f"'{name}'" in result.stderr for name in (*BASELINES, "learned"))


def test_more_episodes_than_the_subset_has_are_refused(task: str, tmp_path: Path) -> None:
    for given, words in ((("squeeze",), "has 24 episodes; with --full 200"), ((task, "--full"), "has 5 episodes\n")):
        result = tacsim("benchmark", "run", *given, "--policy", "random", "--episodes", 201, "--out", tmp_path)
        assert result.exit_code == 2 and words in result.stderr
    assert not list(tmp_path.iterdir())


def test_blind_motion_is_fitted_and_does_not_depend_on_touch(task: str, tmp_path: Path) -> None:
    """It moves as the teacher does on average, so it ends nearer to the goal than random actions."""
    assert tacsim("benchmark", "fit-blind", task, "--episodes", 8, "--environments", 4).exit_code == 0
    ((_, blind), (_, random)) = run(task, tmp_path, "blind", "random", environments=5)
    assert blind.distance is not None and random.distance is not None
    assert blind.distance.value < random.distance.value
    assert len({each.actions for each in blind.episodes}) > 1  # other goals, other motions


def test_blind_motion_does_not_depend_on_observations() -> None:
    """Two numbers at the start, goal and height of the upper arm, decide all actions."""
    weights = BlindWeights(
        task="x", episodes=8, axes=1, mean=(1.0, 0.0, 0.0, 2.0), deviation=(0.5, 0.0, 0.0, 1.0),
        weights=(((0.1, 0.2, 9.0, 9.0, -0.4),), ((-0.5, 0.0, 9.0, 9.0, 0.0),)),
    )  # fmt: skip
    arms: Any = {
        name: SimpleNamespace(pose=Pose(np.array([0.0, 0.0, z]))) for name, z in (("lower", 1.0), ("upper", 3.5))
    }
    first, other = (Observation(time=0.0, tactile={}, arms=each) for each in (arms, {}))
    motion = BlindMotion(weights, start_numbers(1.5, first))
    assert [float(motion(other)[0]) for _ in range(3)] == pytest.approx([0.1 + 0.2 * 1.0 - 0.4 * 0.5, -0.5, -0.5])

"""The same episodes in simulation and on the mock rig, over the real wire."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

import robot.train.benchmark.run as running
from robot.train.benchmark.hashing import hash_document
from robot.train.benchmark.play import score_not_begun
from robot.train.benchmark.run import Run, run_benchmark
from robot.train.benchmark.score import EpisodeScore, NotAScore, Score
from robot.train.benchmark.verify import verify_score
from robot.train.benchmark.wire import WirePlayer
from tests.robot.cli.invoked import tacsim
from tests.robot.train.benchmark.small import TASK, write_task
from tests.tacsim.gym.small import SMALL

# What only a hidden twin has: an elastic mount, an error of an arm, and pictures that are two periods late.
VALUES = {
    **TASK["values"],
    "arms.upper.mount.stiffness": {"choice": ["2 N/mm"]},
    "arms.lower.error.position": {"choice": [["0.2 mm", "0 mm", "0 mm"]]},
    "sensors.lower.delay": {"choice": [2]},
}
POLICIES = ("teacher", "analytic", "random")


@pytest.fixture(scope="module")
def task(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_task(tmp_path_factory.mktemp("task"), episodes=3, values=VALUES, overrides=[*SMALL])


@pytest.mark.slow
@pytest.mark.timeout(900)  # two rigs, each with processes of its own
def test_scores_over_the_wire_are_those_of_the_simulation(task: str, tmp_path: Path) -> None:
    """With the mount, error and delay of each episode; motions settle on both sides."""
    pytest.importorskip("rtde_control", reason="ur_rtde has no wheel here")
    simulated = run_benchmark(Run(task, POLICIES, ("test",), "quick", tmp_path, first=2))
    wired = run_benchmark(Run(task, POLICIES, ("test",), "quick", tmp_path, rig="mock", first=2))
    assert len({path for path, _ in (*simulated, *wired)}) == 6
    for (_, one), (_, other) in zip(simulated, wired, strict=True):
        assert (other.rig, len(other.episodes), other.complete) == ("mock", 2, False)
        for here, there in zip(one.episodes, other.episodes, strict=True):
            assert (here.end, here.steps, here.success) == (there.end, there.steps, there.success)
            # `analytic` sees heights that are found in pictures with noise.
            tolerance = 0.1e-3 if one.policy == "analytic" else 20e-6
            assert here.distance == pytest.approx(there.distance, abs=tolerance), one.policy
            assert here.peak_force == pytest.approx(there.peak_force, rel=0.15), one.policy
    with pytest.raises(NotAScore, match="no two runs have the same bits"):
        verify_score(wired[0][0], 1, task=task)
    result = tacsim("benchmark", "rank", tmp_path, "--other-split", "test", "--other-rig", "mock")
    assert result.exit_code == 0 and "test (mock)" in result.stdout


def test_policies_take_turns_in_each_episode_of_the_wire(
    task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So one rig serves all policies, and a run that was interrupted has the same episodes of each."""
    order: list[tuple[str, int]] = []

    def play(self: WirePlayer, policy: str, numbers: Sequence[int], report: Any) -> Iterator[Any]:
        for number in numbers:
            order.append((policy, number))
            if len(order) == 4:
                raise KeyboardInterrupt
            yield [score_not_begun(number, "a test")], 0.0

    monkeypatch.setattr(running.WirePlayer, "play", play)
    work = Run(task, ("analytic", "random"), ("test",), "quick", tmp_path, rig="mock")
    with pytest.raises(KeyboardInterrupt):
        run_benchmark(work)
    run_benchmark(work)
    numbers = [("analytic", 0), ("random", 0), ("analytic", 1), ("random", 1)]
    assert order == [*numbers, ("random", 1), ("analytic", 2), ("random", 2)]


def test_a_rigid_task_has_no_mock(tmp_path: Path) -> None:
    result = tacsim("benchmark", "run", "hold", "--rig", "mock", "--out", tmp_path / "out")
    assert result.exit_code == 2 and "task 'hold' is of rig 'hand', which has no mock" in result.stderr
    assert not (tmp_path / "out").exists()


def test_scores_of_earlier_versions_name_no_rig() -> None:
    """Their seals hold, and that of a score over the wire depends on it."""
    fields: dict[str, Any] = dict.fromkeys(
        ("task", "kind", "split", "policy", "policy_sha256", "task_sha256", "split_sha256", "sensors_sha256"), "x"
    )
    score = Score.model_validate(
        {
            **fields, "subset": "quick", "number": 1, "physics": {"motion": "", "source": ""},
            "machine": {"vector_width": 256, "device": "cpu", "processor": "", "architecture": ""},
        }
    )  # fmt: skip
    found: list[EpisodeScore] = [score_not_begun(0, "")]
    score = score.with_episodes(found, 0.0, 0.0)
    assert score.computed_seal() == hash_document(score.model_dump(mode="json", exclude={"seal", "rig"}))
    assert score.model_copy(update={"rig": "mock"}).computed_seal() != score.computed_seal()

"""The same unseen episodes for every policy, and intervals that are those of the literature. Needs no torch."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot.deploy.policy import PolicyNotFound
from robot.train.evaluate import EpisodeResult, EvaluationResult, Interval, evaluate
from tests.robot.cli.invoked import tacsim
from tests.robot.train.short import training


def judged(successes: int, of: int, distances: list[float] | None = None) -> EvaluationResult:
    given = distances or [1e-3] * of
    return EvaluationResult("x", tuple(EpisodeResult(given[i], i < successes, float(i), 0.5) for i in range(of)))


def close(found: Interval, *wanted: float) -> None:
    assert (found.value, found.low, found.high) == pytest.approx(wanted, abs=5e-4)


def test_wilson_interval_matches_reference() -> None:
    """z = 1.96, by hand: centre (p + z^2/2n) / (1 + z^2/n), half z/(1 + z^2/n) sqrt(p(1-p)/n + z^2/4n^2)."""
    close(judged(8, 10).success, 0.8, 0.4902, 0.9433)
    close(judged(0, 20).success, 0.0, 0.0, 0.1611)
    close(judged(200, 200).success, 1.0, 0.9812, 1.0)


def test_bootstrap_interval_many_values_is_normal() -> None:
    """Of 400 draws: mean ± 1.96 deviations / 20, to a few percent of its width."""
    values = np.random.default_rng(1).normal(5.0, 2.0, 400)
    found = judged(0, 400, values.tolist()).distance
    half = 1.96 * values.std(ddof=1) / 20
    assert found.value == pytest.approx(values.mean())
    assert found.low == pytest.approx(values.mean() - half, abs=0.1 * half)
    assert found.high == pytest.approx(values.mean() + half, abs=0.1 * half)


def test_peak_force_is_mean_and_95th_percentile() -> None:
    assert judged(0, 21).peak_force == (10.0, 19.0)  # 0, 1, ... 20 N


@pytest.mark.slow
def test_evaluate_teacher_beats_random_in_equal_episodes() -> None:
    settings = training(randomise=None)
    teacher, random, again = evaluate(settings, ["teacher", "random", "teacher"], 5)
    assert len(teacher.episodes) == 5
    assert teacher.episodes == again.episodes
    assert teacher.distance.value < random.distance.value
    starts = [each.distance / (1 - each.improvement) for each in teacher.episodes]
    assert np.ptp(starts) < 1e-9  # one scene, one goal
    other = evaluate(settings, ["random"], 5, seed=1)[0]
    assert other.episodes != random.episodes


@pytest.mark.slow
def test_evaluate_episodes_differ_from_training() -> None:
    drawn = training()
    ends = {seed: [each.distance for each in evaluate(drawn, ["teacher"], 4, seed)[0].episodes] for seed in (0, 1)}
    assert len(set(ends[0])) > 1
    assert ends[0] != ends[1]


def test_evaluate_plays_each_episode_once() -> None:
    """Otherwise intervals would assume too many episodes: of 200 drawn out of 200 only 132 differed."""
    ends = evaluate(training(), ["scripted"], 8)[0].episodes
    assert len({each.distance for each in ends}) == 8


def test_evaluate_missing_policy_raises_before_run() -> None:
    with pytest.raises(PolicyNotFound, match=r"nothing\.onnx"):
        evaluate(training(), ["teacher", "nothing.onnx"], 2)


def test_evaluate_command_writes_table_and_file(tmp_path: Path) -> None:
    file, found = tmp_path / "short.yaml", tmp_path / "found.json"
    file.write_text(json.dumps(training().model_dump(mode="json", exclude_none=True)), encoding="utf-8")
    words = (
        "evaluate",
        str(file),
        "--policy",
        "teacher",
        "--policy",
        "scripted",
        "--episodes",
        "4",
        "--json",
        str(found),
    )
    result = tacsim(*words)
    assert result.exit_code == 0, result.output
    assert "4 unseen episodes, 95 % intervals" in result.stdout
    said = [line.partition(",")[0] for line in result.stderr.splitlines() if " of 4 episodes" in line]
    assert said == [f"{name}: {done} of 4 episodes" for name in ("teacher", "scripted") for done in (3, 4)]
    assert "teacher" in result.stdout and "scripted" in result.stdout
    assert len(json.loads(found.read_text())["scripted"]) == 4
    assert "exists already" in tacsim(*words).stderr


def test_evaluate_command_stopped_keeps_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(training: Any, policies: Any, episodes: int, seed: int, tell: Any, say: Any, warn: Any) -> None:
        say(EvaluationResult("teacher", (EpisodeResult(1e-4, True, 2.0, 0.9),)))
        raise KeyboardInterrupt

    monkeypatch.setattr("robot.train.evaluate.evaluate", stopped)
    found = tmp_path / "a" / "found.json"
    assert tacsim("evaluate", "squeeze", "--json", str(found)).exit_code == 130
    assert [each["distance"] for each in json.loads(found.read_text())["teacher"]] == [1e-4]

"""Comparisons: exact tests and normalisation, by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot.train.benchmark.compare import (
    NotComparable,
    compare_scores,
    make_rows,
    mcnemar_exact,
    normalised_distance,
)
from robot.train.benchmark.fingerprint import Machine, Physics
from robot.train.benchmark.integrity import is_broken, loose_share
from robot.train.benchmark.score import EpisodeScore, Score, write_score
from tests.robot.cli.invoked import tacsim


def episode(number: int, success: bool, distance: float | None = 1e-3, **changed: Any) -> EpisodeScore:
    whole: dict[str, Any] = {
        "episode": number, "success": success, "safe": success, "distance": distance, "start": 2e-3, "peak_force": 1.0,
        "broken": False, "steps": 3, "arrival": 2 if success else None, "end": "steps", "actions": "", "states": "",
    }  # fmt: skip
    return EpisodeScore.model_validate({**whole, **changed})


def score(policy: str, *episodes: EpisodeScore, **changed: Any) -> Score:
    return Score(
        task="small", split="test", subset="quick", policy=policy, policy_sha256="p", task_sha256="t",
        split_sha256="s", sensors_sha256="b", physics=Physics(motion="m", source="c"),
        machine=Machine(vector_width=256, device="cpu", processor="x", architecture="y"), number=24, episodes=episodes,
    ).model_copy(update=changed)  # fmt: skip


def test_mcnemar_is_exact() -> None:
    """Two-sided binomial: 2 * (1 + 5) / 2**5 for 1 against 4; 2 / 2**6 for 0 against 6."""
    assert mcnemar_exact(1, 4) == pytest.approx(2 * 6 / 32)
    assert mcnemar_exact(0, 6) == pytest.approx(2 / 64)
    assert mcnemar_exact(3, 3) == mcnemar_exact(0, 0) == 1.0


def test_comparison_counts_pairs_of_common_episodes() -> None:
    first = score("a", *(episode(n, n in (0, 1, 2), 1e-3 * n) for n in range(6)))
    second = score("b", *(episode(n, n in (0, 5), 2e-3 * n) for n in (0, 2, 3, 4, 5)))
    found = compare_scores(first, second)
    assert (found.episodes, found.both, found.first_alone, found.second_alone, found.neither) == (5, 1, 1, 1, 2)
    assert found.difference is not None and found.difference.value == pytest.approx(-1e-3 * np.mean([0, 2, 3, 4, 5]))
    with pytest.raises(NotComparable, match="split_sha256"):
        compare_scores(first, score("b", episode(0, True), split_sha256="other"))
    with pytest.raises(NotComparable, match="no common episode"):
        compare_scores(first, score("b", episode(9, True)))


def test_distance_is_normalised_by_random_and_teacher() -> None:
    random, teacher = (
        score("random", episode(0, False, 3e-3), episode(1, False, 9e-3)),
        score("teacher", episode(0, True, 1e-3)),
    )
    assert normalised_distance(score("x", episode(0, True, 1.5e-3)), random, teacher) == pytest.approx(0.75)
    assert normalised_distance(random, random, teacher) == 0.0
    assert normalised_distance(score("x", episode(1, True)), random, teacher) is None  # the teacher has not played it
    assert normalised_distance(random, teacher, random) is None


def test_rows_have_what_references_allow() -> None:
    one, two = make_rows([score("x", episode(0, True, 1e-3)), score("random", episode(0, False, 3e-3))])
    assert (one.policy, one.normalised, two.policy) == ("x", None, "random")
    teacher = score("teacher", episode(0, True, 1e-3))
    assert (
        make_rows([score("x", episode(0, True, 2e-3)), score("random", episode(0, False, 3e-3)), teacher])[1].normalised
        == 0.5
    )


def test_body_is_broken_if_a_part_is_apart() -> None:
    """A lattice of 10 x 10 x 10 particles, 1 mm apart; its last layer, a tenth, is moved away."""
    grid = np.stack(np.meshgrid(*[np.arange(10.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * 1e-3
    volume = 1e-6
    assert loose_share(grid, volume) == 0.0
    moved = grid + np.outer(grid[:, 2] > 8.5e-3, [0.0, 0.0, 1.5e-3])
    assert loose_share(moved, volume) == pytest.approx(0.1) and is_broken(moved, volume)
    crumb = grid.copy()
    crumb[:5] -= 5e-3
    assert loose_share(crumb, volume) == pytest.approx(0.005) and not is_broken(crumb, volume)


def test_distances_have_the_unit_of_the_task(tmp_path: Path) -> None:
    """Of `hold` a distance is a share. A score that does not say the kind of its task, as of earlier versions, is one
    of lengths, and its seal holds."""
    write_score(tmp_path / "a.json", score("a", episode(0, True, 0.05), kind="hold"))
    earlier = tmp_path / "b.json"
    write_score(earlier, score("b", episode(0, True, 0.05e-3)))
    text = earlier.read_text(encoding="utf-8")
    earlier.write_text(text.replace(' "kind": "",\n', ""), encoding="utf-8")
    assert '"kind"' not in earlier.read_text(encoding="utf-8") and '"kind"' in text
    result = tacsim("benchmark", "table", tmp_path, "--markdown")
    assert result.exit_code == 0, result.stderr
    assert "| 5.000 (5.000 to 5.000) % |" in result.stdout and "| 0.050 (0.050 to 0.050) mm |" in result.stdout


def test_compare_and_table_commands(tmp_path: Path) -> None:
    one, two = tmp_path / "a.json", tmp_path / "b.json"
    write_score(one, score("a", *(episode(n, True) for n in range(6))))
    write_score(two, score("b", *(episode(n, False) for n in range(6))))
    result = tacsim("benchmark", "compare", one, two)
    assert result.exit_code == 0 and "0.0312" in result.stdout and "6 episodes of small, test" in result.stdout
    result = tacsim("benchmark", "table", tmp_path, "--markdown")
    assert "| small | test | a | 6 (not complete) | 100 (61 to 100) |" in result.stdout
    two.write_text(two.read_text(encoding="utf-8").replace('"success": false', '"success": true'), encoding="utf-8")
    assert tacsim("benchmark", "compare", one, two).exit_code == 3
    assert tacsim("benchmark", "table", tmp_path).exit_code == 3
    write_score(two, score("b", episode(0, False), task="large"))
    assert tacsim("benchmark", "compare", one, two).exit_code == 2

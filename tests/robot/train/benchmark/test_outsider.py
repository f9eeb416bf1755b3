"""The policy of docs/benchmark-submit.md, as an outsider writes it: it runs, and ends nearer to the goal than the
formula."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from robot.train.benchmark.run import Run, run_benchmark
from tests.robot.train.benchmark.small import write_task

ROOT = Path(__file__).resolve().parents[4]
PAGE = (ROOT / "docs/benchmark-submit.md").read_text(encoding="utf-8")
CODE = PAGE.partition("```python\n")[2].partition("```")[0]


def test_it_is_short_and_needs_numpy_alone() -> None:
    assert len([line for line in CODE.splitlines() if line.strip()]) <= 40
    assert [line for line in CODE.splitlines() if "import" in line] == [
        "import numpy as np",
        "from tacsim import Action, Needs, Observation, Pose",
    ]


@pytest.mark.slow
def test_it_beats_the_formula_on_soft_mounts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Mounts of 1 N/mm give way by more than what counts as reached; the formula takes them for rigid."""
    (tmp_path / "outside_policy.py").write_text(CODE, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "outside_policy", raising=False)
    values = {
        "task.goal": {"uniform": ["2 mm", "2.4 mm"]},
        "arms.lower.mount.stiffness": {"choice": ["1 N/mm"]},
        "arms.upper.mount.stiffness": {"choice": ["1 N/mm"]},
    }
    shifts = {"shift-pose": {"overrides": ["task.steps=50"], "values": {"task.goal": {"uniform": ["2 mm", "2.4 mm"]}}}}
    task = write_task(tmp_path, episodes=2, values=values, shifts=shifts)
    policies = ("analytic", "outside_policy:TouchAgain")
    (_, rule), (_, own) = run_benchmark(Run(task, policies, ("shift-pose",), "quick", tmp_path / "out"))
    assert all(each.end == "steps" for each in own.episodes)
    assert rule.distance is not None and own.distance is not None
    assert own.distance.value < 0.5 * rule.distance.value

"""The benchmark on a task with a rigid object, in MuJoCo: played, fitted, verified, and refused without MuJoCo."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from robot.train.benchmark.episodes import draw_episodes, load_task_file
from robot.train.benchmark.run import Run, run_benchmark
from robot.train.benchmark.verify import verify_score
from tests.robot.cli.invoked import tacsim

pytestmark = pytest.mark.slow  # simulations


def write_hold(folder: Path) -> str:
    """The shipped task with episodes of four steps; the path of its file."""
    shipped = load_task_file("hold").model_dump(mode="json", exclude={"shifts"})
    path = folder / "held.yaml"
    path.write_text(json.dumps(shipped | {"overrides": [*shipped["overrides"], "task.steps=4"]}), encoding="utf-8")
    draw_episodes(str(path), 2)
    return str(path)


def test_hold_is_played_and_verified(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    task = write_hold(tmp_path)
    assert tacsim("benchmark", "fit-blind", task, "--episodes", 8, "--environments", 4).exit_code == 0
    policies = ("teacher", "blind", "analytic", "scripted", "random")
    scores = run_benchmark(Run(task, policies, ("test",), "quick", tmp_path / "out", environments=2))
    for path, score in scores:
        assert score.complete and all(each.end in ("steps", "limit") for each in score.episodes)
        assert "mujoco" in score.machine.versions
        assert path.is_file()
    teacher = scores[0][1]
    assert all(not each.broken and each.distance < each.start for each in teacher.episodes)  # type: ignore[operator]
    assert len({score.result_sha256 for _, score in scores}) >= 4  # analytic and scripted loosen alike at first
    found = verify_score(scores[2][0], None, task=task)
    assert found.verdict == "agrees" and len(found.checks) == 2


def test_without_mujoco_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tacsim.sim.engines.mujoco_module import load_mujoco

    load_mujoco.cache_clear()
    monkeypatch.setitem(sys.modules, "mujoco", None)
    try:
        result = tacsim("benchmark", "run", write_hold(tmp_path), "--policy", "random", "--out", tmp_path / "out")
    finally:
        load_mujoco.cache_clear()
    assert result.exit_code == 2 and "pip install 'tacsim[mujoco]'" in result.stderr
    assert "Traceback" not in result.stderr and not (tmp_path / "out").exists()

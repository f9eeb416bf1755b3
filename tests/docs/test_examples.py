"""The examples run, and stand in the docs as they are."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from robot.deploy.control_loop import run_episode
from robot.open import CodeNotFound, load_with_task, make_env, make_vector_env, open_rig
from tacsim.config import ConfigError, json_schema
from tacsim.models.rig import rebuild_rig_config
from tacsim.models.task import TASKS, TaskConfig
from tacsim.tasks import make_task, register_task
from tests.tacsim.gym.small import SMALL

ROOT = Path(__file__).resolve().parents[2]
NAME = "stretch:StretchConfig"
FEW = [*(word for word in SMALL if "task." not in word), "task.goal=0.1 mm", "task.steps=3"]


@pytest.fixture(scope="module", autouse=True)
def on_the_path() -> Iterator[None]:
    sys.path.append(str(ROOT / "examples"))
    before = list(TASKS)
    yield
    sys.path.remove(str(ROOT / "examples"))
    TASKS[:] = before  # as other tests expect it
    rebuild_rig_config()


def test_the_docs_show_the_heart_of_the_example_as_it_is_and_it_is_short() -> None:
    code = (ROOT / "examples" / "stretch.py").read_text(encoding="utf-8")
    page = (ROOT / "docs" / "tasks.md").read_text(encoding="utf-8")
    assert page.partition("```python\n")[2].partition("```")[0] in code
    assert len(code.splitlines()) <= 120


def test_a_task_of_ones_own_runs_and_is_judged_twice() -> None:
    loaded = load_with_task("sim", NAME, FEW)
    assert loaded.config.task is not None
    assert (loaded.config.task.kind, loaded.config.task.goal) == ("stretch", pytest.approx(0.1e-3))
    task = make_task(loaded.config.task)
    with open_rig(loaded) as rig:
        episode = run_episode(rig, task.scripted(), task, 3)
    for step in episode.steps:
        assert step.distance is not None
        assert 0 <= step.info["felt_distance"] < 3e-3
    assert episode.steps[0].distance == pytest.approx(0.1e-3)
    assert episode.meta.task == "stretch"


def test_its_resolved_file_is_read_back(tmp_path: Path) -> None:
    loaded = load_with_task("sim", NAME, FEW)
    (tmp_path / "rig.yaml").write_text(loaded.text)
    assert load_with_task(tmp_path / "rig.yaml").config == loaded.config


@pytest.mark.slow
def test_it_is_an_environment() -> None:
    env = make_env(NAME, overrides=FEW, randomise={"values": {"task.goal": {"uniform": ["0.5 mm", "2 mm"]}}})
    _, info = env.reset(seed=3)
    assert 0.5e-3 <= info["distance"] <= 2e-3
    _, reward, _, _, info = env.step(np.array([0.5, -0.5], np.float32))
    assert reward == pytest.approx(-1e3 * info["distance"])
    env.close()
    envs = make_vector_env(2, NAME, overrides=FEW)
    assert envs.reset(seed=3)[1]["distance"] == pytest.approx([0.1e-3] * 2)
    envs.close()


def test_the_schema_knows_it() -> None:
    load_with_task("sim", NAME)
    assert "StretchConfig" in json_schema("task")["$defs"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("stretch:Stretch", "task 'stretch:Stretch' is a .*, not the configuration of a task"),
        ("stretch:Nothing", "task 'stretch:Nothing': 'stretch' has no 'Nothing'"),
        ("nowhere:Task", "task 'nowhere:Task': no module 'nowhere'"),
        ("tacsim:TaskConfig", "not all its fields have a default"),
    ],
)
def test_what_is_no_task_is_refused(name: str, words: str) -> None:
    with pytest.raises(CodeNotFound, match=words):
        load_with_task("sim", name)


def test_a_mistake_in_its_values_has_its_place() -> None:
    with pytest.raises(ConfigError, match=r"--set task.goal=-1: task.goal: -1 is out of range; allowed: a length > 0"):
        load_with_task("sim", NAME, ["task.goal=-1"])


def test_one_kind_has_one_task() -> None:
    class Other(TaskConfig):
        kind: Literal["squeeze"] = "squeeze"

    class Kindless(TaskConfig):
        pass

    before, task = list(TASKS), make_task
    with pytest.raises(
        ValueError, match=r"there is a task of kind 'squeeze' already, tacsim.models.task.SqueezeConfig"
    ):
        register_task(Other, task)
    with pytest.raises(ValueError, match=r"Kindless must derive from tacsim.TaskConfig and say its kind: Literal"):
        register_task(Kindless, task)
    assert before == TASKS
    with pytest.raises(ValueError, match="no task is made of Other: register_task makes yours known"):
        make_task(Other())


@pytest.mark.deep
def test_it_runs_on_mock_hardware() -> None:
    loaded = load_with_task("mock", NAME, ["scene.preset=learn"])
    assert loaded.config.task is not None
    task = make_task(loaded.config.task)
    with open_rig(loaded) as rig:
        episode = run_episode(rig, task.scripted(), task, 2)
    assert [step.distance is not None and "felt_distance" in step.info for step in episode.steps] == [True] * 3

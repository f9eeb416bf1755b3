"""Sets of episodes: recordings as `tacsim run` makes them, resumed, and taken by the exporter as a folder."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from robot.collect.collect import collect
from robot.collect.episodes import EpisodeJob, EpisodeSet
from robot.collect.experts import hash_data
from robot.collect.workers import Stopped
from robot.open import make_env
from robot.train.benchmark.episodes import load_split
from tacsim.record.episode import Episode
from tacsim.record.reader import read_episode
from tacsim.tasks.task import action_of_vector
from tests.robot.cli.invoked import TINY, tacsim
from tests.robot.train.benchmark.small import write_task

OVERRIDES = tuple(word for word in TINY if word != "--set")


pytestmark = pytest.mark.usefixtures("empty_folder")


def job(count: int, **more: object) -> EpisodeJob:
    given = {"rig": "sim", "overrides": OVERRIDES, "steps": 2, **more}
    return EpisodeJob(EpisodeSet.model_validate(given), count)


def heights(episode: Episode) -> bytes:
    surfaces = [step.frames["upper"].surface for step in episode.steps]
    return b"".join(each.height.tobytes() for each in surfaces if each is not None)


def test_episodes_are_recorded_resumed_and_exported(tmp_path: Path) -> None:
    asked = iter([False, True])
    with pytest.raises(Stopped):
        collect(job(2, policy="random"), tmp_path / "set", {}, "x", stop=lambda: next(asked))
    first = (tmp_path / "set/episode-00000.mcap").read_bytes()
    assert collect(job(2, policy="random"), tmp_path / "set", {}, "x").made == 1
    assert (tmp_path / "set/episode-00000.mcap").read_bytes() == first
    a, b = (read_episode(tmp_path / f"set/episode-0000{number}.mcap") for number in (0, 1))
    assert a.complete and (len(a.steps), a.meta.seed, b.meta.seed, a.meta.policy) == (3, 0, 1, "random")
    assert heights(a) != heights(b)  # another seed, other motions
    collect(job(1, policy="random"), tmp_path / "again", {}, "x")
    assert heights(read_episode(tmp_path / "again/episode-00000.mcap")) == heights(a)
    done = tacsim("export", "lerobot", "set", "--out", "data")
    assert done.exit_code == 0, done.output
    assert json.loads(Path("data/meta/info.json").read_text())["total_episodes"] == 2


def test_what_is_drawn_differs_and_what_cannot_be_is_a_failure(tmp_path: Path) -> None:
    """A body too high for the goal that is asked of it ends its episode, not the set."""
    draws = {"values": {"task.goal": {"choice": ["8 mm", "30 mm"]}}, "seed": 3}
    done = collect(job(4, randomise=draws), tmp_path / "set", {}, "x")
    assert 0 < len(done.failures) < 4 and done.made == 4 - len(done.failures)
    assert all("GoalOutOfReach" in why or "ConfigError" in why for why in done.failures.values())
    assert collect(job(4, randomise=draws), tmp_path / "set", {}, "x").made == 0
    goals = {read_episode(path).meta.goal for path in (tmp_path / "set").glob("*.mcap")}
    assert np.allclose(list(goals), 8e-3)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("mock",), "is not simulated"),
        (("press", "--policy", "random"), "has no task: give one"),
        (("sim", "--policy", "nothing"), "no policy 'nothing'"),
        (("nowhere",), "nowhere"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(words: tuple[str, ...], says: str) -> None:
    tiny = TINY if words[0] == "sim" else ()
    done = tacsim("collect", "episodes", *words, *tiny, "--count", "1", "--out", "set")
    assert done.exit_code == 2 and says in " ".join(done.output.split())
    assert not Path("set").exists()


def test_a_folder_without_recordings_is_refused() -> None:
    Path("empty").mkdir()
    done = tacsim("export", "lerobot", "empty", "--out", "data")
    assert done.exit_code == 2 and "holds no recording" in done.output


@pytest.mark.slow
@pytest.mark.parametrize("task", ["squeeze", "reposition"])
def test_the_teacher_acts_by_the_truth_as_in_an_environment(task: str, tmp_path: Path) -> None:
    """Reward for reward as `TacsimEnv.expert` in the same episode."""
    made = job(1, policy="teacher", task=task, steps=3)
    collect(made, tmp_path / "set", {}, "x")
    episode = read_episode(tmp_path / "set/episode-00000.mcap")
    distances = [step.distance for step in episode.steps]
    assert all(each is not None for each in distances) and len(distances) == 4
    env = make_env(task, "sim", OVERRIDES, learning=False)
    env.rig.reset(0)
    start = env.rig.truth()
    assert start is not None
    targets = {name: arm.pose for name, arm in env.rig.observe().arms.items()}
    for step in episode.steps[1:]:
        truth = env.rig.truth()
        assert truth is not None and step.action is not None
        vector = env.task.expert(truth, start)
        assert vector is not None
        action = action_of_vector(vector, env.task.axes, env.task.config.max_step, targets)
        for name, pose in action.tool.items():
            sent = step.action.tool[name]
            assert pose is not None and sent is not None and np.allclose(pose.position, sent.position, atol=1e-9)
            targets[name] = pose
        env.rig.step(action)
    env.close()


@pytest.mark.slow
def test_a_data_set_of_experts_has_a_card_and_a_hash(tmp_path: Path) -> None:
    """Made twice it has the same bits; its episodes are none of the benchmark's, and a second call makes nothing."""
    task = write_task(tmp_path, episodes=4, overrides=list(OVERRIDES))
    words = ("collect", "experts", task, "--count", "2", "--workers", "1", "--set", "task.steps=2")
    first, second = (tacsim(*words, "--out", name, "--json") for name in ("one", "two"))
    assert first.exit_code == 0, first.output
    found, again = (json.loads(each.stdout) for each in (first, second))
    assert found["sha256"] == again["sha256"] == hash_data(Path("one/lerobot"))
    card = Path("one/lerobot/README.md").read_text()
    assert (
        found["sha256"] in card
        and f"config_name: small-{found['sha256'][:12]}" in card
        and "path: data/*/*.parquet" in card
        and "reaches the goal in" in card
    )
    info = json.loads(Path("one/lerobot/meta/info.json").read_text())
    state, environment = (info["features"][f"observation.{key}"]["names"] for key in ("state", "environment_state"))
    assert info["total_episodes"] == 2 and state[-1] == "goal_0.vel"
    assert environment == [name for name in state if name.endswith(".vel")]
    goals = {read_episode(path).meta.goal for path in Path("one/episodes").glob("*.mcap")}
    frozen = set(load_split(task).episodes[0].values())
    assert len(goals) == 2 and not {f"{1e3 * goal:.5g} mm" for goal in goals if isinstance(goal, float)} & frozen
    shutil.rmtree("one/lerobot")
    assert tacsim(*words, "--no-pictures", "--out", "one").exit_code == 0
    assert "observation.images.lower" not in Path("one/lerobot/meta/info.json").read_text()
    more = tacsim(*words[:4], "3", *words[5:], "--no-pictures", "--out", "one")
    assert more.exit_code == 2 and "2 episodes without pictures, now these are 3" in " ".join(more.output.split())

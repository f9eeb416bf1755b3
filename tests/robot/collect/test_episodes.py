"""Sets of episodes: recordings as `tacsim run` makes them, resumed, and taken by the exporter as a folder."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from robot.collect.collect import collect
from robot.collect.episodes import EpisodeJob, EpisodeSet
from robot.collect.workers import Stopped
from tacsim.record.episode import Episode
from tacsim.record.reader import read_episode
from tests.robot.cli.invoked import TINY, tacsim

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

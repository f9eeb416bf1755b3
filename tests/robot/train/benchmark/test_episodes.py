"""Frozen episodes: what is drawn once is read from files, and a changed file is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from robot.train.benchmark.episodes import (
    SplitChanged,
    draw_episodes,
    episode_path,
    load_split,
    load_task_file,
    shipped_tasks,
    training_split,
)
from robot.train.benchmark.hashing import canonical_json, hash_document, uniform_numbers
from tacsim.config import ConfigError
from tests.robot.train.benchmark.small import TASK, write_task

# Of the split `test` of each shipped task, as its scores name it. A change of one of them ends v1.
FROZEN = json.loads((Path(__file__).parent / "frozen.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", shipped_tasks())
def test_shipped_splits_are_frozen(name: str) -> None:
    """Hashes of episodes, of what is simulated and judged, and of sensors: none may change within v1."""
    found = {}
    for split in load_task_file(name).splits:
        loaded = load_split(name, split)
        assert len(loaded.episodes) == 200
        found[split] = [loaded.sha256, loaded.task_sha256, loaded.sensors_sha256]
    assert found == FROZEN[name], "v1 is frozen: undo the change, or begin v2"


@pytest.mark.parametrize("name", shipped_tasks())
def test_shipped_tasks_have_all_splits_and_a_reason(name: str) -> None:
    task = load_task_file(name)
    shifts = ("material", "friction", "gel", "pose", "light", "mesh", "all")
    assert set(task.splits) == {"test", *(f"shift-{each}" for each in shifts)}
    assert len(task.reason) > 80


def test_shift_changes_its_own_values_alone(tmp_path: Path) -> None:
    name = write_task(tmp_path)
    test, shifted = load_split(name), load_split(name, "shift-material")
    for one, other in zip(test.episodes, shifted.episodes, strict=True):
        assert one["task.goal"] == other["task.goal"]
        assert other["scene.body.material.yield_stress"] in ("60 kPa", "80 kPa")
    assert test.sha256 != shifted.sha256
    assert test.task_sha256 == shifted.task_sha256


def test_training_draws_are_others(tmp_path: Path) -> None:
    name = write_task(tmp_path)
    goals = {each["task.goal"] for each in load_split(name).episodes}
    assert not goals & {each["task.goal"] for each in training_split(name, 4).episodes}


def test_changed_episode_is_refused(tmp_path: Path) -> None:
    name = write_task(tmp_path)
    path = episode_path(Path(name))
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("60 kPa", "61 kPa", 1), encoding="utf-8")
    with pytest.raises(SplitChanged, match="have been changed"):
        load_split(name)
    path.write_text(text[:-20], encoding="utf-8")
    with pytest.raises(SplitChanged, match="no file of episodes"):
        load_split(name)
    path.unlink()
    with pytest.raises(SplitChanged, match="benchmark draw"):
        load_split(name)


def test_draw_overwrites_nothing(tmp_path: Path) -> None:
    name = write_task(tmp_path)
    with pytest.raises(FileExistsError):
        draw_episodes(name)


def test_draw_refuses_a_value_that_the_task_does_not_have(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"yield_sterss"):
        write_task(tmp_path, values={"scene.body.material.yield_sterss": {"uniform": ["5 kPa", "6 kPa"]}})
    assert not (tmp_path / "small.episodes.json").exists()


def test_another_version_or_split_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.yaml"
    path.write_text(json.dumps(TASK | {"version": "v2"}), encoding="utf-8")
    with pytest.raises(ConfigError, match="v1"):
        load_task_file(str(path))
    with pytest.raises(ValueError, match="did you mean 'shift-material'"):
        load_split(write_task(tmp_path), "shift-materiel")


def test_hash_is_that_of_canonical_json() -> None:
    """SHA-256 of {"a":[1.5,"µ"],"b":null} in UTF-8, by sha256sum."""
    assert canonical_json({"b": None, "a": [1.5, "µ"]}) == '{"a":[1.5,"µ"],"b":null}'.encode()
    assert hash_document({}) == "44136fa355b3678a1146ad16f7e8649e94fb4fc21fe77e8310c060f61caaff8a"
    with pytest.raises(ValueError):
        canonical_json(float("nan"))


def test_random_actions_follow_from_the_key_alone() -> None:
    """First bytes of SHA-256("a:0"): as sha256sum prints them."""
    import hashlib

    first = int(hashlib.sha256(b"a:0").hexdigest()[:8], 16)
    numbers = uniform_numbers("a", 20_000)
    assert numbers[0] == first / 2**31 - 1.0
    assert min(numbers) >= -1.0 and max(numbers) < 1.0
    assert abs(sum(numbers) / len(numbers)) < 0.02
    assert uniform_numbers("b", 1) != numbers[:1]

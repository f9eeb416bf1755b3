"""Tasks of the benchmark and their frozen episodes.

The values of each episode are drawn once and written to NAME.episodes.json next to the task file. A run reads them from
there and draws nothing: another version of NumPy cannot change an episode. The file holds all values of the split
`test`; of another split only the values that it draws itself, so episode 17 of two splits differs in these alone.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from robot.common.whole_file import write_whole
from robot.open import load_with_task
from robot.train.benchmark.hashing import hash_document
from tacsim.config import load_model, shipped_names
from tacsim.config.kinds import KINDS, is_name, shipped_file
from tacsim.models.benchmark import EPISODES, QUICK_EPISODES, TEST_SPLIT, BenchmarkTask
from tacsim.models.quantity import Config
from tacsim.models.rig import RigConfig
from tacsim.models.text import suggest_word

SEED = 1_971_000  # of the draws; no training uses it
TRAINING_SEED = 2_971_000  # of draws that a baseline may be fitted to
NUMBER = re.compile(r"(?<![\w.])-?\d+\.\d+(?:[eE][-+]?\d+)?|(?<![\w.])-?\d+[eE][-+]?\d+")


class DrawnSplit(Config):
    """The values of one split: row `i` belongs to episode `i`."""

    keys: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


class EpisodeFile(Config):
    """Content of NAME.episodes.json. `sha256` is of the rest, as canonical JSON."""

    version: str
    task: str  # name of the task file
    splits: dict[str, DrawnSplit]
    sha256: str

    def computed_hash(self) -> str:
        """The hash of the present content."""
        return hash_document(self.model_dump(mode="json", exclude={"sha256"}))


class SplitChanged(ValueError):
    """The frozen episodes are not those that the file was written with."""


@dataclass(frozen=True, slots=True)
class Split:
    """Episodes that a policy is scored in."""

    task: BenchmarkTask
    file: str  # name or path of the task file
    name: str
    episodes: tuple[Mapping[str, str], ...]  # values by key, as of --set

    @property
    def task_name(self) -> str:
        """Name of the task in scores: that of its file, without its folder."""
        return Path(self.file).stem

    @property
    def overrides(self) -> tuple[str, ...]:
        """Of the rig, in all episodes."""
        return self.task.split_overrides(self.name)

    def episode_overrides(self, number: int) -> list[str]:
        """Overrides of episode `number`, in addition to those of all episodes."""
        return [f"{key}={value}" for key, value in self.episodes[number].items()]

    def episode_seed(self, number: int) -> int:
        """Seed of the reset of an episode (placement, noise): its number, in every split."""
        return number

    @property
    def sha256(self) -> str:
        """Of all episodes, with their seeds."""
        return hash_document(
            [{"seed": self.episode_seed(number), "values": dict(values)} for number, values in enumerate(self.episodes)]
        )

    def load_config(self, number: int | None = None) -> RigConfig:
        """The rig of an episode; None: before its values are set. Raises ConfigError."""
        words = [] if number is None else self.episode_overrides(number)
        return load_with_task(self.task.rig, self.task.task, [*self.overrides, *words]).config

    @property
    def task_sha256(self) -> str:
        """Of what is simulated and judged before the values of an episode are set: the rig with all references written
        out, without values that are defaults, and the force of a safe success."""
        config: dict[str, Any] = self.load_config().model_dump(mode="json", exclude_defaults=True)
        config.pop("sensors", None)
        return hash_document({"rig": config, "max_force": self.task.max_force})

    @property
    def sensors_sha256(self) -> str:
        """Of the sensors of the rig: gels, pictures, calibration."""
        config: dict[str, Any] = self.load_config().model_dump(mode="json", exclude_defaults=True)
        return hash_document(config["sensors"])


def subset_size(subset: str, episodes: int = EPISODES) -> int:
    """Number of episodes of `quick` or `full`."""
    return min(QUICK_EPISODES, episodes) if subset == "quick" else episodes


def task_path(name: str) -> Path:
    """Path of a task file: a shipped one by its name, or the path itself. Raises NotFound."""
    return shipped_file(KINDS["benchmark"], name, Path.cwd()) if is_name(name) else Path(name)


def episode_path(task_file: Path) -> Path:
    """Path of the frozen episodes of a task file."""
    return task_file.with_name(f"{task_file.stem}.episodes.json")


def shipped_tasks() -> list[str]:
    """Names of the tasks of the benchmark, easy ones first."""
    return sorted(shipped_names("benchmark"), key=lambda name: (load_task_file(name).level != "easy", name))


def load_task_file(name: str) -> BenchmarkTask:
    """The content of a task file. Raises ConfigError."""
    return load_model(BenchmarkTask, name)


def load_split(name: str, split: str = TEST_SPLIT) -> Split:
    """A split of a task, with its frozen episodes. Raises ConfigError, SplitChanged, ValueError for another split."""
    task, path = load_task_file(name), episode_path(task_path(name))
    if split not in task.splits:
        raise ValueError(
            f"task '{name}' has no split '{split}'; it has {', '.join(task.splits)}{suggest_word(split, task.splits)}"
        )
    found = _read_episodes(path, name)
    missing = [each for each in (TEST_SPLIT, split) if each not in found.splits]
    if missing:
        raise SplitChanged(
            f"{path}: no episodes of the split '{missing[0]}', which the task file has; draw them again: tacsim "
            "benchmark draw"
        )
    base = _rows(found.splits[TEST_SPLIT])
    own = _rows(found.splits[split]) if split != TEST_SPLIT else [{} for _ in base]
    if len(own) not in (0, len(base)):
        raise SplitChanged(f"{path}: split '{split}' has {len(own)} episodes, 'test' has {len(base)}")
    episodes = [{**values, **more} for values, more in zip(base, own or [{} for _ in base], strict=True)]
    return Split(task, name, split, tuple(episodes))


def _rows(drawn: DrawnSplit) -> list[dict[str, str]]:
    return [dict(zip(drawn.keys, row, strict=True)) for row in drawn.rows]


def _read_episodes(path: Path, name: str) -> EpisodeFile:
    if not path.is_file():
        raise SplitChanged(f"{path}: no such file; draw the episodes of the task: tacsim benchmark draw {name}")
    try:
        found = EpisodeFile.model_validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "text"
        raise SplitChanged(f"{path}: no file of episodes: {where}: {first['msg']}") from None
    computed = found.computed_hash()
    if computed != found.sha256:
        raise SplitChanged(
            f"{path}: its episodes have been changed: their hash is {computed[:12]}, the file says "
            f"{found.sha256[:12]}. Restore the file; scores of other episodes cannot be compared"
        )
    return found


def draw_episodes(name: str, episodes: int = EPISODES) -> Path:
    """Draws the episodes of a task file and writes them next to it. Raises FileExistsError if they exist already,
    ConfigError for a value that the task does not have."""
    task, path = load_task_file(name), episode_path(task_path(name))
    if path.exists():
        raise FileExistsError(17, "File exists", str(path))
    splits = {split: draw_split(task, split, SEED, episodes) for split in task.splits}
    stem = task_path(name).stem
    drawn = EpisodeFile(version=task.version, task=stem, splits=splits, sha256="")
    for split in task.splits:
        base, own = _rows(splits[TEST_SPLIT]), _rows(splits[split])
        Split(task, name, split, ({**base[0], **(own[0] if own else {})},)).load_config(0)  # raises for a wrong key
    whole = drawn.model_copy(update={"sha256": drawn.computed_hash()})
    write_whole(path, _episode_text(whole).encode())
    return path


def _episode_text(found: EpisodeFile) -> str:
    """JSON with one line for each episode."""
    head = {"version": found.version, "task": found.task, "sha256": found.sha256}
    parts = []
    for name, split in found.splits.items():
        rows = ",\n".join(json.dumps(row, ensure_ascii=False) for row in split.rows)
        parts.append(f'{json.dumps(name)}: {{"keys": {json.dumps(split.keys)}, "rows": [\n{rows}\n]}}')
    return f'{json.dumps(head)[:-1]}, "splits": {{\n' + ",\n".join(parts) + "\n}}\n"


def draw_split(task: BenchmarkTask, split: str, seed: int, episodes: int) -> DrawnSplit:
    """Draws the values of a split; of a shift only its own. Numbers have five digits."""
    keys = tuple(task.values if split == TEST_SPLIT else task.shifts[split].values)
    if not keys:
        return DrawnSplit(keys=(), rows=())
    rows = []
    for words in task.randomisation(split, seed, episodes).draw_overrides():
        drawn = dict(word.split("=", 1) for word in words)
        rows.append(tuple(NUMBER.sub(lambda match: f"{float(match[0]):.5g}", drawn[key]) for key in keys))
    return DrawnSplit(keys=keys, rows=tuple(rows))


def training_split(name: str, episodes: int) -> Split:
    """Episodes that are drawn like those of `test`, by another seed: to fit a baseline to."""
    task = load_task_file(name)
    return Split(task, name, TEST_SPLIT, tuple(_rows(draw_split(task, TEST_SPLIT, TRAINING_SEED, episodes))))

"""Data sets of expert episodes of a task of the benchmark. The teacher acts in episodes that are drawn like those of
the split `test`, by another seed, so that none of them is a test."""

from __future__ import annotations

import hashlib
import json
import textwrap
from collections.abc import Callable
from pathlib import Path

import numpy as np

from robot.collect.episodes import TEACHER, EpisodeSet
from robot.collect.workers import SetError
from robot.common.whole_file import write_whole
from robot.deploy.control_loop import versions
from robot.export.lerobot import export_lerobot
from robot.export.lerobot_mapping import IMAGE
from robot.open import load_with_task
from tacsim.config import load_model
from tacsim.models.benchmark import TEST_SPLIT, BenchmarkTask
from tacsim.models.text import printable_line
from tacsim.record.reader import read_episode

SEED = 3_971_000  # of the draws; neither the tests nor a baseline of the benchmark use it
RECORDINGS, DATA_SET, CARD = "episodes", "lerobot", "README.md"  # in the folder of a set


def expert_set(task: str, overrides: tuple[str, ...] = ()) -> EpisodeSet:
    """The settings of expert episodes of a task of the benchmark, a name or a path. Raises ConfigError."""
    known = load_model(BenchmarkTask, task)
    return EpisodeSet(
        rig=known.rig,
        task=known.task,
        overrides=(*known.split_overrides(TEST_SPLIT), *overrides),
        policy=TEACHER,
        randomise=known.randomisation(TEST_SPLIT, SEED),
    )


def write_expert_data(
    folder: Path, task: str, command: str, on_step: Callable[[int, int], None], *, pictures: bool = True
) -> str:
    """Makes the LeRobot data set of the recordings in `folder`, with its card. Returns its hash (`hash_data`). One that
    is there already, of as many episodes, stays. Raises SetError, and the errors of `export_lerobot`."""
    recordings, data = sorted((folder / RECORDINGS).glob("*.mcap")), folder / DATA_SET
    if data.exists():
        there = json.loads((data / "meta/info.json").read_text(encoding="utf-8"))
        episodes, has_pictures = there["total_episodes"], any(key.startswith(IMAGE) for key in there["features"])
        if episodes != len(recordings) or has_pictures != pictures:
            raise SetError(
                f"{data} has {episodes} episodes with{'' if has_pictures else 'out'} pictures, now these are "
                f"{len(recordings)} with{'' if pictures else 'out'}: delete it, then repeat"
            )
    else:
        export_lerobot(recordings, data, maps=False, environment=True, pictures=pictures, on_step=on_step)
    digest = hash_data(data)
    write_whole(data / CARD, _card(task, recordings, data, command, digest).encode())
    return digest


def hash_data(data_set: Path) -> str:
    """SHA-256 of the Parquet files in the folder `data` of a data set, with their paths. Equal settings give an equal
    hash on processors of one vector width, with the same versions of tacsim and pyarrow."""
    digest = hashlib.sha256()
    for path in sorted((data_set / "data").rglob("*.parquet")):
        digest.update(f"{path.relative_to(data_set).as_posix()}\0{path.stat().st_size}\0".encode())
        with path.open("rb") as file:
            while block := file.read(2**20):
                digest.update(block)
    return digest.hexdigest()


def _card(task: str, recordings: list[Path], data: Path, command: str, digest: str) -> str:
    """The card of a data set as Markdown; its head says to `datasets` where the rows are."""
    info = json.loads((data / "meta/info.json").read_text(encoding="utf-8"))
    known, name = load_model(BenchmarkTask, task), printable_line(Path(task).stem)
    columns = "\n".join(
        f"| `{key}` | {each['dtype']} {tuple(each['shape'])} |" for key, each in sorted(info["features"].items())
    )
    task_config = load_with_task(known.rig, known.task, known.split_overrides(TEST_SPLIT)).config.task
    assert task_config is not None
    ends = np.array([read_episode(path).steps[-1].distance for path in recordings], np.float64)
    reached, unit = int(np.sum(ends <= task_config.success)), task_config.unit
    made_with = ", ".join(f"{package} {number}" for package, number in versions().items())
    values = "\n".join(
        f"| `{key}` | {json.dumps(each.model_dump(mode='json', exclude_none=True))} |"
        for key, each in known.values.items()
    )
    # `datasets` stores what it has read by the names of folder and configuration, whatever the files are: with the hash
    # in the name no other set of that folder name is taken for this one.
    return f"""---
configs:
- config_name: {name}-{digest[:12]}
  data_files:
  - split: train
    path: data/*/*.parquet
tags:
- LeRobot
- tactile
- simulation
---

# Expert episodes of {name}

{textwrap.fill(printable_line(known.reason), 120)}

{info["total_episodes"]} episodes, {info["total_frames"]} frames at {info["fps"]:g} a second, simulated by tacsim. The
expert is the teacher, which knows the ground truth. It reaches the goal in {reached} of {len(ends)} episodes; the
median of the distance at the end is {unit.show(float(np.median(ends)))}.

SHA-256 of `data/`: `{digest}`

```python
from datasets import load_dataset

frames = load_dataset("FOLDER", split="train").with_format("numpy")
```

LeRobot: `LeRobotDataset("me/{name}", root="FOLDER")`.

| column | type, shape |
|---|---|
{columns}

Names of the numbers are in `meta/info.json`; their scales, and goal and seed of each episode, in `meta/tacsim.json`. A
number times its scale is in SI units. Pictures are the canonical ones: 128 means no change.
`observation.environment_state` is touch and goal once more: with it LeRobot's ACT learns without pictures.

Drawn for each episode, by a seed that no test of the benchmark uses:

| value | distribution |
|---|---|
{values}

Limits: simulated only; the expert acts by what no sensor measures, so some of its actions cannot be learned from the
columns alone.

Made by

```bash
{command}
```

with {made_with}. Licence: that of tacsim (MIT).
"""

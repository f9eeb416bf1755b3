"""Content of a task file of the benchmark of policies: a task, the distributions of its episodes, and what shifts."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from tacsim.models.quantity import Config, Force
from tacsim.models.randomisation import Distribution, Randomisation

VERSION: Literal["v1"] = "v1"  # of the rules: splits, scores, hashes
TEST_SPLIT = "test"
EPISODES = 200  # of each split
QUICK_EPISODES = 24  # the first of them: the quick subset
Values = Annotated[dict[str, Distribution], Field(max_length=100)]
SplitName = Annotated[str, Field(pattern=r"^shift-[a-z][a-z0-9-]*$", max_length=40)]


class Shift(Config):
    """How a split differs from the split `test`: other distributions for some values, or overrides of all episodes."""

    values: Values = {}  # replace those of the test split, or are added to them
    overrides: tuple[str, ...] = ()  # as of --set; for what an environment cannot change between episodes

    @model_validator(mode="after")
    def _require_contents(self) -> Self:
        if not self.values and not self.overrides:
            raise ValueError("a shift without values and without overrides is the split 'test': give one of them")
        return self


class BenchmarkTask(Config):
    """One task of the benchmark: ``configs/benchmark/v1/NAME.yaml``. The drawn episodes are in NAME.episodes.json."""

    version: Literal["v1"]
    task: str  # name or path, as of `tacsim run --task`
    rig: str = "sim"  # name or path of a simulated one
    level: Literal["easy", "standard"] = "standard"  # easy: for a first hour, one formula may solve it
    reason: str  # why poses alone or one formula do not solve it; of an easy task, what it shows
    overrides: tuple[str, ...] = ()  # of the rig, in all splits
    max_force: Annotated[Force, Field(gt=0)]  # of a safe success: peak of the normal force [N]
    values: Annotated[dict[str, Distribution], Field(min_length=1, max_length=100)]  # of the split `test`
    shifts: dict[SplitName, Shift] = {}

    @property
    def splits(self) -> tuple[str, ...]:
        """Names of all splits; `test` is the first."""
        return (TEST_SPLIT, *self.shifts)

    def randomisation(self, split: str, seed: int, draws: int = EPISODES) -> Randomisation:
        """The distributions of a split. Raises KeyError for another."""
        values = dict(self.values) if split == TEST_SPLIT else {**self.values, **self.shifts[split].values}
        return Randomisation(draws=draws, seed=seed, values=values)

    def split_overrides(self, split: str) -> tuple[str, ...]:
        """Overrides of the rig in all episodes of a split. Raises KeyError for another."""
        return self.overrides if split == TEST_SPLIT else (*self.overrides, *self.shifts[split].overrides)

"""The folder of a training run: its settings and its last checkpoint, from which the run continues."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Self

from pydantic import Field, ValidationError

from robot.common.cluster import tacsim_version
from robot.common.whole_file import write_whole
from tacsim.models.policy import PolicySpec, Training
from tacsim.models.quantity import Config
from tacsim.models.text import printable_line

FORMAT = 2  # of run.json and of checkpoints; other versions are refused
CHECKPOINT = "checkpoint.pt"
ReportProgress = Callable[[str, int, int], None]  # text, amount done, total amount


class RunError(ValueError):
    """A folder without a run that can continue or be exported."""


class RunSettings(Config):
    """run.json: all inputs of a run."""

    format: int = FORMAT
    tacsim: str = ""  # version that started the run
    training: Training
    spec: PolicySpec  # of the resulting policy
    shapes: dict[str, tuple[int, ...]] = Field(min_length=1)  # of the features


class RunFolder:
    """One run. Raises RunError for a folder without a run, or with one of another version."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        path = folder / "run.json"
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            raise RunError(f"{folder} is not the folder of a training run: it has no run.json") from None
        except (OSError, UnicodeDecodeError) as failure:
            raise RunError(f"{path} cannot be read: {failure}") from None
        try:
            written = json.loads(text)["format"]
            if written != FORMAT:
                raise RunError(
                    f"{path} has format {printable_line(str(written))}, this version of tacsim continues format "
                    f"{FORMAT}: continue with the version that started the run, or start a new training"
                )
            self.settings = RunSettings.model_validate_json(text)
        except (ValidationError, json.JSONDecodeError, TypeError, KeyError) as failure:
            raise RunError(f"{path} cannot be read: {printable_line(str(failure).splitlines()[0])}") from None

    @classmethod
    def make(cls, folder: Path, training: Training, spec: PolicySpec, shapes: Mapping[str, tuple[int, ...]]) -> Self:
        """Creates a new run. Raises FileExistsError if the folder exists."""
        settings = RunSettings(tacsim=tacsim_version(), training=training, spec=spec, shapes=dict(shapes))
        folder.mkdir(parents=True)
        text = settings.model_dump_json(indent=1)
        write_whole(folder / "run.json", text.encode())
        return cls(folder)

    def save_checkpoint(self, number: int, state: Mapping[str, Any], curve: list[dict[str, float]]) -> None:
        """Writes a checkpoint after round `number` over the last one. `curve`: one row of figures per round."""
        import torch

        content = {"format": FORMAT, "rounds": number + 1, "state": dict(state), "curve": curve}
        write_whole(self.folder / CHECKPOINT, lambda file: torch.save(content, file))

    def load_checkpoint(self) -> tuple[int, dict[str, Any], list[dict[str, float]]]:
        """Number of completed rounds, the state after them, and their figures. Raises RunError."""
        import torch

        path = self.folder / CHECKPOINT
        if not path.exists():
            return 0, {}, []
        try:
            found = torch.load(path, weights_only=True)  # tensors and numbers only; refuses code
            if found["format"] != FORMAT:
                raise RunError(f"{path} has format {found['format']}, this version of tacsim continues format {FORMAT}")
            return int(found["rounds"]), dict(found["state"]), list(found["curve"])
        except RunError:
            raise
        except Exception as failure:  # torch has no common base class for damaged files
            words = printable_line((str(failure).splitlines() or [repr(failure)])[0][:200])
            raise RunError(f"{path} is not a checkpoint of this version: {words}; start a new training") from None

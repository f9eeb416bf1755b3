"""The folder of a training run: its settings, and the last checkpoint, from which it goes on to the same end."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, Self

from pydantic import Field, ValidationError

from robot.common.whole_file import write_whole
from tacsim.models.policy import PolicySpec
from tacsim.models.quantity import Config
from tacsim.models.text import printable_line
from tacsim.models.training import Training

FORMAT = 1  # of run.json and of checkpoints; other versions are refused
CHECKPOINT = "checkpoint.pt"
Tell = Callable[[str, int, int], None]  # what is being done, how much of it is done, of how much


class RunError(ValueError):
    """A folder that holds no run which could go on, or be exported."""


class RunSettings(Config):
    """run.json: all that a run is a function of."""

    format: int = FORMAT
    tacsim: str = ""  # version that began it
    training: Training
    spec: PolicySpec  # of the policy that it makes
    shapes: dict[str, tuple[int, ...]] = Field(min_length=1)  # of the features


class RunFolder:
    """One run. Raises RunError for a folder that holds none, or one of another version."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        path = folder / "run.json"
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            raise RunError(f"{folder} holds no training run: there is no run.json in it") from None
        except (OSError, UnicodeDecodeError) as failure:
            raise RunError(f"{path} cannot be read: {failure}") from None
        try:
            written = json.loads(text)["format"]
            if written != FORMAT:
                raise RunError(
                    f"{path} has format {printable_line(str(written))}, this version of tacsim goes on with {FORMAT}: "
                    "go on with the version that began the run, or train anew"
                )
            self.settings = RunSettings.model_validate_json(text)
        except (ValidationError, json.JSONDecodeError, TypeError, KeyError) as failure:
            raise RunError(f"{path} cannot be read: {printable_line(str(failure).splitlines()[0])}") from None

    @classmethod
    def make(cls, folder: Path, training: Training, spec: PolicySpec, shapes: Mapping[str, tuple[int, ...]]) -> Self:
        """A new one. Raises FileExistsError if there is such a folder."""
        settings = RunSettings(tacsim=version(), training=training, spec=spec, shapes=dict(shapes))
        folder.mkdir(parents=True)
        text = settings.model_dump_json(indent=1)
        write_whole(folder / "run.json", text.encode())
        return cls(folder)

    def keep(self, number: int, state: Mapping[str, Any], curve: list[dict[str, float]]) -> None:
        """A checkpoint after round `number`, in place of the last one. The curve has a row of figures a round."""
        import torch

        content = {"format": FORMAT, "rounds": number + 1, "state": dict(state), "curve": curve}
        write_whole(self.folder / CHECKPOINT, lambda file: torch.save(content, file))

    def last(self) -> tuple[int, dict[str, Any], list[dict[str, float]]]:
        """Rounds done, the state after them, and their figures; 0 rounds where none is done. Raises RunError."""
        import torch

        path = self.folder / CHECKPOINT
        if not path.exists():
            return 0, {}, []
        try:
            found = torch.load(path, weights_only=True)  # tensors and numbers; code in it is refused
            if found["format"] != FORMAT:
                raise RunError(f"{path} has format {found['format']}, this version of tacsim goes on with {FORMAT}")
            return int(found["rounds"]), dict(found["state"]), list(found["curve"])
        except RunError:
            raise
        except Exception as failure:  # torch has no common base of what a broken file raises
            words = printable_line((str(failure).splitlines() or [repr(failure)])[0][:200])
            raise RunError(f"{path} is no checkpoint of this version: {words}; train anew") from None


def version() -> str:
    """Of tacsim; empty where it is not installed."""
    try:
        return metadata.version("tacsim")
    except metadata.PackageNotFoundError:
        return ""

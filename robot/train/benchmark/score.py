"""Score files: one policy on one split of one task, with every episode and the hashes of all that it depends on."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError

from robot.common.whole_file import write_whole
from robot.train.benchmark.fingerprint import Machine, Physics
from robot.train.benchmark.hashing import hash_document
from robot.train.evaluate import Interval, bootstrap_interval, wilson_interval
from tacsim.models.benchmark import VERSION
from tacsim.models.quantity import Config
from tacsim.models.task import Unit, unit_of
from tacsim.models.text import printable_line

MAX_BYTES = 32 * 2**20  # of a file; 200 episodes have 100 kB
RigName = Literal["sim", "mock"]
# How an episode ended: after its steps, at a limit of force, by divergence of the simulation, by an error of the
# policy, or before its first step because the reset failed.
End = Literal["steps", "limit", "diverged", "error", "not begun"]


class EpisodeScore(Config):
    """One episode."""

    episode: Annotated[int, Field(ge=0)]
    success: bool  # at its end the goal is reached, and no limit was exceeded
    safe: bool  # success, with a peak force below `max_force`, and the body in one piece
    distance: float | None  # from the goal at the end [m]; None: not begun
    start: float | None  # the same at the start [m]
    peak_force: float  # maximum normal force [N]
    broken: bool  # the body is in pieces
    steps: int  # control steps that were played
    arrival: int | None  # control steps until the goal was reached for good; None: never
    end: End
    reason: str = ""  # of an end before the last step
    outside: bool | None = None  # a learned policy left the range of its training; None: unknown
    # SHA-256 over the bits of all steps: what the policy did, and what followed from it
    actions: str
    states: str


class Score(Config):
    """Content of a score file. `seal` is the hash of all else: it shows that a file was edited, not by whom."""

    format: Literal[1] = 1
    version: Literal["v1"] = VERSION
    task: str  # name of the task file
    kind: str = ""  # of the task: the unit of its distances; "" in scores of lengths that do not say it
    split: str
    subset: Literal["quick", "full"]
    rig: RigName = "sim"  # mock: over the real wire; its bits are not hashed
    policy: str  # as given to --policy
    policy_sha256: str  # of its file; of a built-in policy of its name
    task_sha256: str
    split_sha256: str
    sensors_sha256: str
    physics: Physics
    machine: Machine
    number: int  # of episodes that belong to it
    episodes: tuple[EpisodeScore, ...] = ()  # those that are played, by number
    wall_seconds: float = 0.0  # of all episodes, together with the others of their batch [s]
    policy_seconds: float = 0.0  # of these inside the policy [s]
    seal: str = ""

    @property
    def complete(self) -> bool:
        return len(self.episodes) == self.number

    @property
    def unit(self) -> Unit:
        """In which its distances are shown."""
        return unit_of(self.kind)

    @property
    def missing(self) -> list[int]:
        """Numbers of the episodes that are not played yet."""
        done = {each.episode for each in self.episodes}
        return [number for number in range(self.number) if number not in done]

    @property
    def where(self) -> str:
        """Its split, and its rig where that is not the simulation."""
        return self.split if self.rig == "sim" else f"{self.split} ({self.rig})"

    def computed_seal(self) -> str:
        # Scores of earlier versions have neither kind nor rig.
        unknown = {key for key, default in (("kind", ""), ("rig", "sim")) if getattr(self, key) == default}
        return hash_document(self.model_dump(mode="json", exclude={"seal", *unknown}))

    def with_episodes(self, more: Sequence[EpisodeScore], wall: float, policy: float) -> Score:
        """With more episodes and the seconds that they took [s]."""
        episodes = sorted([*self.episodes, *more], key=lambda each: each.episode)
        return self.model_copy(
            update={
                "episodes": tuple(episodes),
                "wall_seconds": round(self.wall_seconds + wall, 3),
                "policy_seconds": round(self.policy_seconds + policy, 3),
            }
        )

    @property
    def result_sha256(self) -> str:
        """Of the bits of all episodes: two runs of a policy have the same, whatever time they took."""
        return hash_document([[each.episode, each.actions, each.states, each.end] for each in self.episodes])

    @property
    def subject(self) -> dict[str, Any]:
        """What must be equal for more episodes to belong to this score."""
        return self.model_dump(
            mode="json", exclude={"episodes", "wall_seconds", "policy_seconds", "seal", "machine", "policy", "kind"}
        ) | {"vector_width": self.machine.vector_width, "device": self.machine.device}

    @property
    def success(self) -> Interval:
        """Rate of success, with Wilson's 95 % interval."""
        return wilson_interval(sum(each.success for each in self.episodes), len(self.episodes))

    @property
    def safe_success(self) -> Interval:
        """Rate of safe success, with Wilson's 95 % interval."""
        return wilson_interval(sum(each.safe for each in self.episodes), len(self.episodes))

    @property
    def distance(self) -> Interval | None:
        """Mean distance at the end [m], with a bootstrap interval; None if no episode began."""
        import numpy as np

        known = [each.distance for each in self.episodes if each.distance is not None]
        return bootstrap_interval(np.array(known)) if known else None


class NotAScore(ValueError):
    """A file is no score of this version."""


class ScoreEdited(ValueError):
    """A score file is not as it was written."""


def read_score(path: Path) -> Score:
    """Reads a score file. Raises NotAScore, ScoreEdited, OSError."""
    if path.stat().st_size > MAX_BYTES:
        raise NotAScore(f"{path}: {path.stat().st_size / 2**20:.0f} MiB; a score has at most {MAX_BYTES >> 20} MiB")
    data = path.read_bytes()
    try:
        score = Score.model_validate_json(data)
    except ValidationError as error:
        first = error.errors()[0]
        where = printable_line(".".join(map(str, first["loc"])) or "text")
        hint = ""
        if where in ("version", "format"):
            hint = f"; this tacsim reads {where} {VERSION if where == 'version' else 1}, use the version that wrote it"
        raise NotAScore(
            f"{path}: no score of the benchmark {VERSION}: {where}: {printable_line(first['msg'])}{hint}"
        ) from None
    numbers = [each.episode for each in score.episodes]
    if (
        score.computed_seal() != score.seal
        or numbers != sorted(set(numbers))
        or (numbers and numbers[-1] >= score.number)
    ):
        raise ScoreEdited(
            f"{path}: edited after it was written (its hash is {score.computed_seal()[:12]}, the file says "
            f"{score.seal[:12]}): run the policy again, into a new folder"
        )
    return score


def write_score(path: Path, score: Score) -> Score:
    """Writes a score file as a whole, and returns the sealed score."""
    sealed = score.model_copy(update={"seal": ""})
    sealed = sealed.model_copy(update={"seal": sealed.computed_seal()})
    write_whole(path, (sealed.model_dump_json(indent=1) + "\n").encode())
    return sealed


def score_path(folder: Path, score: Score) -> Path:
    """Where a score is; that of a policy in a file has the beginning of its hash in the name."""
    policy = score.policy
    name = re.sub(r"[^A-Za-z0-9_.-]+", ".", Path(policy).stem if policy.endswith((".onnx", ".csv")) else policy)
    mark = f"-{score.policy_sha256[:8]}" if re.search(r"[:/.]", policy) else ""
    kinds = f"{'' if score.rig == 'sim' else '.mock'}{'' if score.subset == 'full' else '.quick'}"
    return folder / score.task / score.split / f"{name}{mark}{kinds}.json"


def find_scores(folder: Path) -> list[tuple[Path, Score]]:
    """All scores below a folder, by path. Raises NotAScore, ScoreEdited."""
    return [(path, read_score(path)) for path in sorted(folder.rglob("*.json")) if not path.name.startswith(".")]

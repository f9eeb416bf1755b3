"""Compares policies in simulation and on a hidden twin, which differs: the loss of success by transfer.

Each policy plays each episode twice: in the simulation of its training, which knows of the twin only what a person can
see (the task and the shape of the body or the object), and on the twin, with all parameters drawn. The twin of the rig
`sim` is the mock rig, over the real wire; the twin of a rig in MuJoCo is the same rig with other parameters.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from robot.common import loopback_host
from robot.common.process_pool import ProcessPool
from robot.deploy.control_loop import EpisodeFailed, EpisodeSetup, run_episode
from robot.deploy.onnx_policy import OnnxPolicy
from robot.deploy.policy import load_policy, require_fit
from robot.open import open_rig
from robot.train.evaluate import HELD_OUT_SEED_OFFSET, Interval, bootstrap_interval, wilson_interval
from tacsim.config import LoadedRig, load_rig
from tacsim.gym.env import RESET_ERRORS
from tacsim.interface import RigSpec
from tacsim.models.policy import Training
from tacsim.models.randomisation import Randomisation
from tacsim.models.task import LENGTH, TaskConfig, Unit
from tacsim.record.episode import TACTILE_DISTANCE, Episode
from tacsim.rig import Rig
from tacsim.tasks import make_task

Side = Literal["simulation", "twin"]
SIDES: tuple[Side, ...] = ("simulation", "twin")
RIGS = {"simulation": "sim", "twin": "mock"}
KNOWN_KEYS = ("task.", "scene.body.geometry", "scene.object.geometry")  # of a twin, visible to a person
ROWS_FILE = "episodes.jsonl"


@dataclass(frozen=True)
class Study:
    """Settings of a comparison. Its folder can continue only with the same settings, except for the policies."""

    task: str
    policies: tuple[str, ...]
    twins: Randomisation
    episodes: int  # of each policy on each side
    episodes_per_hidden_rig: int  # a new twin after this number of episodes
    steps: int | None  # of an episode; None: the task's
    overrides: tuple[str, ...]  # of both rigs

    @cached_property
    def config(self) -> TaskConfig:
        """Of its task."""
        task = load_rig("sim", task=self.task).config.task
        assert task is not None
        return task

    def rig(self, side: Side) -> str:
        """Name of the rig of a side: of a task with a rigid object the hand in MuJoCo on both."""
        return "hand" if self.config.scene.object is not None else RIGS[side]

    @property
    def json_text(self) -> str:
        whole = asdict(self) | {"twins": self.twins.model_dump(mode="json")}
        del whole["policies"]  # more may be added later
        return json.dumps(whole, indent=1) + "\n"


@dataclass(frozen=True, slots=True)
class EpisodeResult:
    """Result of one episode."""

    policy: str
    side: Side
    episode: int
    distance: float | None  # by the truth [SI]; None if it did not begin
    tactile_distance: float | None  # estimated from touch alone [SI]
    success: bool
    peak_force: float  # [N]
    error: str = ""  # that ended it early, or why it did not begin


def play_study(
    study: Study, folder: Path, report_progress: Callable[[str, int, int], None], workers: int = 1
) -> list[EpisodeResult]:
    """Plays all episodes that the folder does not have; each result is written to it at once. Returns all results.
    Raises ValueError if the folder has another study, and the errors of opening rigs and reading policies.

    workers: number of parallel processes, each with its own rig.
    """
    rows, settings = folder / ROWS_FILE, folder / "study.json"
    if settings.exists():
        if settings.read_text(encoding="utf-8") != study.json_text:
            raise ValueError(
                f"{folder} has a study with other settings; give another folder, or the settings of study.json"
            )
    else:
        settings.write_text(study.json_text, encoding="utf-8")
    done = {(each.policy, each.side, each.episode): each for each in _read_rows(rows)}
    _write_rows(rows, done.values())  # without an incomplete last line, to which the next would be appended
    requested = [(p, side, n) for p in study.policies for side in SIDES for n in range(study.episodes)]
    remaining = [each for each in requested if each not in done]
    parts: dict[tuple[Side, int], list[tuple[str, int]]] = {}
    for policy, side, number in sorted(remaining, key=lambda each: SIDES.index(each[1])):
        parts.setdefault((side, number // study.episodes_per_hidden_rig), []).append((policy, number))
    results = _play_in_turn(study, parts) if workers == 1 else _play_in_parallel(study, parts, workers)
    with rows.open("a", encoding="utf-8") as file:
        for each in results:
            done[each.policy, each.side, each.episode] = each
            file.write(_json_line(each))
            file.flush()
            ready = sum(each in done for each in requested)
            report_progress(
                f"{each.policy}, {each.side}: {_describe_result(each, study.config.unit)}", ready, len(requested)
            )
    return [done[each] for each in requested]


Parts = Mapping[tuple[Side, int], Sequence[tuple[str, int]]]  # by side and twin: policies and episodes


def _play_in_turn(study: Study, parts: Parts) -> Iterator[EpisodeResult]:
    for (side, twin), remaining in parts.items():
        yield from _play_on_hidden_rig(study, side, twin, remaining)


def _play_in_parallel(study: Study, parts: Parts, workers: int) -> Iterator[EpisodeResult]:
    with ProcessPool(workers) as pool:
        futures = [
            pool.submit(_play_in_process, study, side, twin, [each for each in remaining if each[0] == policy])
            for (side, twin), remaining in parts.items()
            for policy in dict.fromkeys(name for name, _ in remaining)
        ]
        for future in as_completed(futures):
            yield from future.result()


def _play_in_process(
    study: Study, side: Side, hidden_rig: int, remaining: Sequence[tuple[str, int]]
) -> list[EpisodeResult]:
    """Plays in a separate process, whose mocks have separate addresses."""
    address = 77  # second number of mock addresses in parallel processes
    overrides: list[str] = []
    if study.rig(side) == RIGS["twin"]:
        for number, name in enumerate(load_rig(RIGS[side]).config.arms, start=1):
            host = loopback_host(number, address)
            overrides += [f"arms.{name}.host={host}", f"sensors.{name}.source=http://{host}:8081/?action=stream"]
    return list(
        _play_on_hidden_rig(replace(study, overrides=(*study.overrides, *overrides)), side, hidden_rig, remaining)
    )


def _describe_result(results: EpisodeResult, unit: Unit) -> str:
    if results.error or results.distance is None:
        return results.error or "no distance"
    return f"{unit.show(results.distance)} from the goal{'' if results.success else ', not reached'}"


def _read_rows(rows: Path) -> Iterator[EpisodeResult]:
    """Results of the complete lines."""
    for line in rows.read_text(encoding="utf-8").splitlines() if rows.exists() else []:
        try:
            yield EpisodeResult(**json.loads(line))
        except (json.JSONDecodeError, TypeError):  # the last line of a run that was killed
            continue


def _write_rows(rows: Path, results: Iterable[EpisodeResult]) -> None:
    whole = rows.with_suffix(".new")
    whole.write_text("".join(map(_json_line, results)), encoding="utf-8")
    whole.replace(rows)


def _json_line(results: EpisodeResult) -> str:
    return json.dumps(asdict(results)) + "\n"


def _play_on_hidden_rig(
    study: Study, side: Side, hidden_rig: int, remaining: Sequence[tuple[str, int]]
) -> Iterator[EpisodeResult]:
    """Uses one rig for all episodes on a twin; in simulation one per episode, because each policy has its own."""
    groups = [remaining] if side == "twin" else [[each] for each in remaining]
    for group in groups:
        loaded = [_load_rig(study, side, hidden_rig, number, policy) for policy, number in group]
        with open_rig(loaded[0]) as rig:
            for (policy, number), each in zip(group, loaded, strict=True):
                yield _play_episode(study, side, rig, each, policy, number)


def _load_rig(study: Study, side: Side, hidden_rig: int, number: int, policy: str | None = None) -> LoadedRig:
    """The rig of an episode. Values of the task, and values drawn only by the training of a policy, are drawn for each
    episode, all others for each twin."""
    drawn = study.twins.model_copy(update={"draws": max(study.episodes, hidden_rig + 1)}).draw_overrides()
    overrides = [word for word in drawn[hidden_rig] if not word.startswith("task.")]
    overrides += [word for word in drawn[number] if word.startswith("task.")]
    if side == "simulation":
        overrides = [word for word in overrides if word.startswith(KNOWN_KEYS)]
        overrides = [*_training_overrides(policy, study, number), *overrides]
    return load_rig(study.rig(side), task=study.task, overrides=[*study.overrides, *overrides])


def _training_overrides(policy: str | None, study: Study, number: int) -> list[str]:
    """Overrides of the training rig of a learned policy, for draw `number`; empty for other policies."""
    if policy is None or not (policy == "learned" or policy.endswith(".onnx")):
        return []
    loaded = load_rig(study.rig("simulation"), task=study.task)
    assert loaded.config.task is not None
    nothing = RigSpec({}, (), truth=False, period=loaded.config.period)
    loaded_policy = load_policy(policy, make_task(loaded.config.task), nothing, loaded.config.canonical)
    assert isinstance(loaded_policy, OnnxPolicy)
    training_data = loaded_policy.spec.trained.get("training")
    if training_data is None:
        return []
    training = Training.model_validate(training_data)
    drawn = training.randomise
    if drawn is None:
        return list(training.overrides)
    held_out = drawn.model_copy(update={"draws": number + 1, "seed": HELD_OUT_SEED_OFFSET + drawn.seed})
    return [*training.overrides, *held_out.draw_overrides()[number]]


def _play_episode(study: Study, side: Side, rig: Rig, loaded: LoadedRig, policy: str, number: int) -> EpisodeResult:
    assert loaded.config.task is not None
    task, canonical = make_task(loaded.config.task), loaded.config.canonical
    loaded_policy = load_policy(policy, task, rig.spec, canonical)
    require_fit(rig.name, rig.spec, loaded_policy, policy, task)
    steps = task.config.steps if study.steps is None else study.steps
    error = ""
    try:
        episode: Episode = run_episode(
            rig, loaded_policy, task, steps, setup=EpisodeSetup(policy, number, canonical=canonical)
        )
    except RESET_ERRORS as refused:  # the same for each policy: not reached
        return EpisodeResult(policy, side, number, None, None, False, 0.0, error=f"did not begin: {refused}")
    except EpisodeFailed as failed:
        episode, error = failed.episode, str(failed)
    if not error and len(episode.steps) <= steps:
        raise KeyboardInterrupt  # which a run treats as its end: not a result
    distances = [step.distance for step in episode.steps if step.distance is not None]
    forces = [abs(float(arm.wrench[2])) for step in episode.steps for arm in step.arms.values()]
    last = distances[-1] if distances else None
    max_force = task.config.force_limit
    is_within_limit = not error and (max_force is None or max(forces) <= max_force)
    return EpisodeResult(
        policy,
        side,
        number,
        last,
        episode.steps[-1].info.get(TACTILE_DISTANCE) if episode.steps else None,
        success=last is not None and last <= task.config.success and is_within_limit,
        peak_force=max(forces, default=0.0),
        error=error,
    )


@dataclass(frozen=True, slots=True)
class SummaryRow:
    """Summary of one policy on one side."""

    policy: str
    side: Side
    success: Interval  # rate
    distance: Interval | None  # mean [SI]; None if no episode began
    agreement: float | None  # root mean square of tactile minus true distance [SI]
    failures: int  # episodes ended by an error


def summarise(results: Sequence[EpisodeResult]) -> list[SummaryRow]:
    """Summaries by policy and side, in their order."""
    rows = []
    for policy, side in dict.fromkeys((each.policy, each.side) for each in results):
        selected = [each for each in results if (each.policy, each.side) == (policy, side)]
        known = [each.distance for each in selected if each.distance is not None]
        gaps = [
            each.tactile_distance - each.distance
            for each in selected
            if each.tactile_distance is not None and each.distance is not None
        ]
        rows.append(
            SummaryRow(
                policy,
                side,
                wilson_interval(sum(each.success for each in selected), len(selected)),
                bootstrap_interval(np.array(known)) if known else None,
                float(np.sqrt(np.mean(np.square(gaps)))) if gaps else None,
                sum(bool(each.error) for each in selected),
            )
        )
    return rows


def label_policies(names: Sequence[str]) -> list[str]:
    """Short names: those of the files, with their folders where files have the same name."""
    stems = [Path(name).stem for name in names]
    if len(set(stems)) == len(stems):
        return stems
    return [Path(*Path(name).with_suffix("").parts[-2:]).as_posix() for name in names]


def draw_figure(rows: Sequence[SummaryRow], path: Path, unit: Unit = LENGTH) -> None:
    """Draws success and distance of each policy on both sides, with intervals."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 1.6 + 0.7 * len(rows) / 2), layout="constrained")
    names = list(dict.fromkeys(row.policy for row in rows))
    for axes, what, scale, symbol in zip(
        figure.subplots(1, 2, sharey=True), ("success", "distance"), (100, unit.factor), ("%", unit.symbol), strict=True
    ):
        for side, colour, shift in (("simulation", "#9fb4c8", -0.15), ("twin", "#1f3a5f", 0.15)):
            there = [(row, getattr(row, what)) for row in rows if row.side == side]
            selected = [(names.index(row.policy) + shift, interval) for row, interval in there if interval is not None]
            if not selected:
                continue
            values = scale * np.array([each.value for _, each in selected])
            errors = scale * np.abs(np.array([[i.value - i.low, i.high - i.value] for _, i in selected]).T)
            axes.errorbar(values, [y for y, _ in selected], xerr=errors, fmt="o", color=colour, label=side, capsize=3)
        axes.set_title(what, loc="left", fontsize=10)
        axes.set_xlabel(symbol)
        axes.set_yticks(range(len(names)), [label.replace("$", r"\$") for label in label_policies(names)])
        axes.set_xlim(left=0)
    axes.invert_yaxis()
    axes.legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=120)

"""The same policies in simulation and on the mock rig, whose hidden twin differs: what of their success is kept.

Each episode is played twice by each policy: in the simulation that it was trained in, which has of the twin only what a
person sees of it (the task and the body's shape), and on the mock rig, over the real wire, with all that the twin was
drawn to be.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from robot.common.loopback import loopback_host
from robot.common.process import ProcessPool
from robot.deploy.control_loop import EpisodeFailed, EpisodeSetup, run_episode
from robot.deploy.onnx_policy import OnnxPolicy
from robot.deploy.policy import load_policy, require_fit
from robot.open import open_rig
from robot.train.evaluate import UNSEEN, Interval, bootstrap, wilson
from tacsim.config import LoadedRig, load_rig
from tacsim.interface import RigSpec
from tacsim.models.randomisation import Randomisation
from tacsim.models.training import Training
from tacsim.record.episode import Episode
from tacsim.record.step_info import TACTILE_DISTANCE
from tacsim.rig import Rig
from tacsim.tasks import make_task

Side = Literal["simulation", "twin"]
SIDES: tuple[Side, ...] = ("simulation", "twin")
RIGS = {"simulation": "sim", "twin": "mock"}
SEEN = ("task.", "scene.body.geometry")  # of a twin, by a person
ROWS = "episodes.jsonl"


@dataclass(frozen=True, slots=True)
class Study:
    """What is compared; its folder goes on only with the same, but for the policies."""

    task: str
    policies: tuple[str, ...]
    twins: Randomisation
    episodes: int  # of each policy on each side
    changing: int  # every so many episodes another twin
    steps: int | None  # of an episode; None: the task's
    overrides: tuple[str, ...]  # of both rigs

    @property
    def text(self) -> str:
        whole = asdict(self) | {"twins": self.twins.model_dump(mode="json")}
        del whole["policies"]  # to which others may come later
        return json.dumps(whole, indent=1) + "\n"


@dataclass(frozen=True, slots=True)
class Played:
    """How one episode ended."""

    policy: str
    side: Side
    episode: int
    distance: float | None  # by the truth [m]; None where it never began
    felt: float | None  # by touch alone [m]
    success: bool
    peak_force: float  # [N]
    error: str = ""  # what ended it early


def play(study: Study, folder: Path, tell: Callable[[str, int, int], None], workers: int = 1) -> list[Played]:
    """All episodes, those that the folder has already read from there; each is written to it as it ends. Raises
    ValueError where the folder has another study, and what opening rigs and reading policies raises.

    workers: processes side by side, each with a rig of its own.
    """
    rows, settings = folder / ROWS, folder / "study.json"
    if settings.exists():
        if settings.read_text(encoding="utf-8") != study.text:
            raise ValueError(
                f"{folder} has a study of other settings; name another folder, or give those of study.json"
            )
    else:
        settings.write_text(study.text, encoding="utf-8")
    done = {(each.policy, each.side, each.episode): each for each in _read(rows)}
    _write(rows, done.values())  # without a line that was cut off, which the next would be glued to
    asked = [(p, side, n) for p in study.policies for side in SIDES for n in range(study.episodes)]
    left = [each for each in asked if each not in done]
    parts: dict[tuple[Side, int], list[tuple[str, int]]] = {}
    for policy, side, number in sorted(left, key=lambda each: SIDES.index(each[1])):
        parts.setdefault((side, number // study.changing), []).append((policy, number))
    played = _one_by_one(study, parts) if workers == 1 else _side_by_side(study, parts, workers)
    with rows.open("a", encoding="utf-8") as file:
        for each in played:
            done[each.policy, each.side, each.episode] = each
            file.write(_line(each))
            file.flush()
            ready = sum(each in done for each in asked)
            tell(f"{each.policy}, {each.side}: {_ended(each)}", ready, len(asked))
    return [done[each] for each in asked]


Parts = Mapping[tuple[Side, int], Sequence[tuple[str, int]]]  # by side and twin: policies and episodes


def _one_by_one(study: Study, parts: Parts) -> Iterator[Played]:
    for (side, twin), left in parts.items():
        yield from _on_twin(study, side, twin, left)


def _side_by_side(study: Study, parts: Parts, workers: int) -> Iterator[Played]:
    with ProcessPool(workers) as pool:
        futures = [
            pool.submit(_apart, study, side, twin, [each for each in left if each[0] == policy])
            for (side, twin), left in parts.items()
            for policy in dict.fromkeys(name for name, _ in left)
        ]
        for future in as_completed(futures):
            yield from future.result()


def _apart(study: Study, side: Side, twin: int, left: Sequence[tuple[str, int]]) -> list[Played]:
    """In a process of its own, whose mocks have addresses of their own."""
    address = 77  # second number of the addresses of mocks in processes of their own
    words: list[str] = []
    if side == "twin":
        for number, name in enumerate(load_rig(RIGS[side]).config.arms, start=1):
            host = loopback_host(number, address)
            words += [f"arms.{name}.host={host}", f"sensors.{name}.source=http://{host}:8081/?action=stream"]
    return list(_on_twin(replace(study, overrides=(*study.overrides, *words)), side, twin, left))


def _ended(played: Played) -> str:
    if played.error or played.distance is None:
        return played.error or "it never began"
    return f"{1e3 * played.distance:.3f} mm from the goal{'' if played.success else ', not reached'}"


def _read(rows: Path) -> Iterator[Played]:
    """Those that were written whole."""
    for line in rows.read_text(encoding="utf-8").splitlines() if rows.exists() else []:
        try:
            yield Played(**json.loads(line))
        except (json.JSONDecodeError, TypeError):  # the last line of a run that was killed
            continue


def _write(rows: Path, played: Iterable[Played]) -> None:
    whole = rows.with_suffix(".new")
    whole.write_text("".join(map(_line, played)), encoding="utf-8")
    whole.replace(rows)


def _line(played: Played) -> str:
    return json.dumps(asdict(played)) + "\n"


def _on_twin(study: Study, side: Side, twin: int, left: Sequence[tuple[str, int]]) -> Iterator[Played]:
    """One rig for all on a twin; in simulation one for each episode, as each policy has a simulation of its own."""
    groups = [left] if side == "twin" else [[each] for each in left]
    for group in groups:
        loaded = [_loaded(study, side, twin, number, policy) for policy, number in group]
        with open_rig(loaded[0]) as rig:
            for (policy, number), each in zip(group, loaded, strict=True):
                yield _episode(study, side, rig, each, policy, number)


def _loaded(study: Study, side: Side, twin: int, number: int, policy: str | None = None) -> LoadedRig:
    """The rig of an episode: its task's values are drawn anew for each episode, all others for each twin. What only the
    training of a policy draws, for each episode."""
    drawn = study.twins.model_copy(update={"draws": max(study.episodes, twin + 1)}).drawn()
    words = [word for word in drawn[twin] if not word.startswith("task.")]
    words += [word for word in drawn[number] if word.startswith("task.")]
    if side == "simulation":
        words = [word for word in words if word.startswith(SEEN)]
        words = [*_own_simulation(policy, study.task, number), *words]
    return load_rig(RIGS[side], task=study.task, overrides=[*study.overrides, *words])


def _own_simulation(policy: str | None, task: str, number: int) -> list[str]:
    """Overrides of the rig that a learned policy was trained in, its draw `number`; none of another policy."""
    if policy is None or not (policy == "learned" or policy.endswith(".onnx")):
        return []
    loaded = load_rig(RIGS["simulation"], task=task)
    assert loaded.config.task is not None
    nothing = RigSpec({}, (), truth=False, period=loaded.config.period)
    acts = load_policy(policy, make_task(loaded.config.task), nothing, loaded.config.canonical)
    assert isinstance(acts, OnnxPolicy)
    told = acts.spec.trained.get("training")
    if told is None:
        return []
    training = Training.model_validate(told)
    drawn = training.randomise
    if drawn is None:
        return list(training.overrides)
    unseen = drawn.model_copy(update={"draws": number + 1, "seed": UNSEEN + drawn.seed})
    return [*training.overrides, *unseen.drawn()[number]]


def _episode(study: Study, side: Side, rig: Rig, loaded: LoadedRig, policy: str, number: int) -> Played:
    assert loaded.config.task is not None
    task, canonical = make_task(loaded.config.task), loaded.config.canonical
    acts = load_policy(policy, task, rig.spec, canonical)
    require_fit(rig.name, rig.spec, acts, policy, task)
    steps = task.config.steps if study.steps is None else study.steps
    error = ""
    try:
        episode: Episode = run_episode(rig, acts, task, steps, setup=EpisodeSetup(policy, number, canonical=canonical))
    except EpisodeFailed as failed:
        episode, error = failed.episode, str(failed)
    if not error and len(episode.steps) <= steps:
        raise KeyboardInterrupt  # which a run takes for its end: that is no result
    distances = [step.distance for step in episode.steps if step.distance is not None]
    forces = [abs(float(arm.wrench[2])) for step in episode.steps for arm in step.arms.values()]
    last = distances[-1] if distances else None
    most = task.config.force_limit
    within = not error and (most is None or max(forces) <= most)
    return Played(
        policy,
        side,
        number,
        last,
        episode.steps[-1].info.get(TACTILE_DISTANCE) if episode.steps else None,
        success=last is not None and last <= task.config.success and within,
        peak_force=max(forces, default=0.0),
        error=error,
    )


@dataclass(frozen=True, slots=True)
class Row:
    """One policy on one side."""

    policy: str
    side: Side
    success: Interval  # share
    distance: Interval | None  # mean [m]; None where no episode began
    agreement: float | None  # root mean square of felt minus true distance [m]
    failures: int  # episodes that an error ended


def summary(played: Sequence[Played]) -> list[Row]:
    """By policy and side, in their order."""
    rows = []
    for policy, side in dict.fromkeys((each.policy, each.side) for each in played):
        mine = [each for each in played if (each.policy, each.side) == (policy, side)]
        known = [each.distance for each in mine if each.distance is not None]
        gaps = [each.felt - each.distance for each in mine if each.felt is not None and each.distance is not None]
        rows.append(
            Row(
                policy,
                side,
                wilson(sum(each.success for each in mine), len(mine)),
                bootstrap(np.array(known)) if known else None,
                float(np.sqrt(np.mean(np.square(gaps)))) if gaps else None,
                sum(bool(each.error) for each in mine),
            )
        )
    return rows


def picture(rows: Sequence[Row], path: Path) -> None:
    """Success and distance of each policy on both sides, with their intervals."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 1.6 + 0.7 * len(rows) / 2), layout="constrained")
    names = list(dict.fromkeys(row.policy for row in rows))
    for axes, what, scale, unit in zip(
        figure.subplots(1, 2, sharey=True), ("success", "distance"), (100, 1e3), ("%", "mm"), strict=True
    ):
        for side, colour, shift in (("simulation", "#9fb4c8", -0.15), ("twin", "#1f3a5f", 0.15)):
            there = [(row, getattr(row, what)) for row in rows if row.side == side]
            mine = [(names.index(row.policy) + shift, interval) for row, interval in there if interval is not None]
            if not mine:
                continue
            values = scale * np.array([each.value for _, each in mine])
            away = scale * np.abs(np.array([[i.value - i.low, i.high - i.value] for _, i in mine]).T)
            axes.errorbar(values, [y for y, _ in mine], xerr=away, fmt="o", color=colour, label=side, capsize=3)
        axes.set_title(what, loc="left", fontsize=10)
        axes.set_xlabel(unit)
        axes.set_yticks(range(len(names)), [Path(name).stem.replace("$", r"\$") for name in names])
        axes.set_xlim(left=0)
    axes.invert_yaxis()
    axes.legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=120)

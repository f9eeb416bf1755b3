"""`tacsim collect`: sets of presses and of episodes, many at once."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer

from robot.cli.errors import FAILED, complain
from robot.cli.options import OptionGroup, Overrides, Preset, SensorModel, grouped, quantity, require_packages
from robot.cli.output import busy, notes, one_bar, results
from robot.cli.terminal import Interrupt

if TYPE_CHECKING:
    from robot.collect.collect import Collected
    from robot.collect.episodes import EpisodeJob
    from robot.collect.presses import PressJob

collect = typer.Typer(no_args_is_help=True, help="Make sets of presses or of episodes, many at once.")

NUMBER = re.compile(r"\s*[-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?\s*")

Count = Annotated[int, typer.Option(min=1, max=10_000_000, help="How many; more than before makes a set longer.")]
OutSet = Annotated[
    Path, typer.Option("--out", metavar="DIR", help="Folder of the set; one that was begun by this command goes on.")
]
Seed = Annotated[int, typer.Option(min=0, help="Same seed, same set.")]
Workers = Annotated[
    int | None, typer.Option(min=1, max=1024, help="Processes on this machine.", show_default="one a core")
]
Ray = Annotated[
    str | None,
    typer.Option(
        "--ray", metavar="ADDRESS", help="Make it on a Ray cluster: HOST:PORT, auto, or local (extra cluster)."
    ),
]


class Between(NamedTuple):
    """Least and greatest, and how a person said it."""

    low: float
    high: float
    text: str


def between(kind: str) -> Callable[[str], Between]:
    """Parser of an option that is one length or angle, or a range of them: "0.1..1.0mm"."""

    def parse(text: str) -> Between:
        first, dots, second = str(text).partition("..")
        if not dots:
            second = first
        elif NUMBER.fullmatch(first):
            first += NUMBER.sub("", second, count=1)
        low, high = (quantity(kind)(part.strip()) for part in (first, second))
        if low > high:
            raise typer.BadParameter(f"'{text}' goes from the larger to the smaller; say {second}..{first}")
        return Between(low, high, text)

    return parse


def range_of(kind: str, help_: str) -> Any:
    return typer.Option(parser=between(kind), metavar="RANGE", help=help_)


class PressRanges(OptionGroup):
    """Options whose values are drawn for each press."""

    depth: Annotated[Any, range_of("length", "How deep below the untouched gel.")] = "0.1..1.0mm"
    pose: Annotated[
        Literal["random", "centred"], typer.Option(help="random: anywhere in the picture, turned any way.")
    ] = "random"
    tilt: Annotated[Any, range_of("angle", "Off the vertical, any way; of random poses.")] = "0..5deg"
    shear: Annotated[Any, range_of("length", "Then sideways, any way.")] = "0"
    twist: Annotated[Any, range_of("angle", "Then about the vertical.")] = "0"


@grouped
def press(
    out: OutSet,
    *,
    objects: Annotated[
        str, typer.Option(metavar="DIR|shapes", help="A folder of STL files, or the twenty shapes of tacsim.")
    ] = "shapes",
    drawn: PressRanges,
    count: Count = 100,
    seed: Seed = 0,
    sensor: SensorModel = "ideal",
    preset: Preset = "standard",
    scale: Annotated[float, typer.Option(help="Metres per unit of the STL files.")] = 1e-3,
    workers: Workers = None,
    ray: Ray = None,
    set_: Overrides = None,
) -> None:
    """Press objects on a gel, each elsewhere: pictures with heights, forces, contact, flow and poses, in parquet files.

    Loads by `datasets.load_dataset("DIR")`; DIR/README.md says what is in it. Killed anywhere, the same command goes
    on. --set changes the scene (tacsim schema scene). Needs the extra 'export'.

    Example: tacsim collect press --depth 0.1..1.0mm --count 500 --out presses
    """
    given = [
        ("--objects", objects, None), ("--depth", drawn.depth.text, None), ("--pose", drawn.pose, None),
        ("--tilt", drawn.tilt.text if drawn.pose == "random" else None, None), ("--shear", drawn.shear.text, "0"),
        ("--twist", drawn.twist.text, "0"),
        ("--count", str(count), None), ("--seed", str(seed), None), ("--sensor", sensor, None),
        ("--preset", preset, None),
        ("--scale", f"{scale:g}", "0.001"), *(("--set", text, None) for text in set_ or []), ("--out", str(out), None),
    ]  # fmt: skip
    require_packages("tacsim collect press", "export", "pyarrow")
    with busy("loading"):
        from robot.collect.objects import find_objects
        from robot.collect.presses import PressJob, PressSet
        from tacsim.config import load_scene, load_sensor
        from tacsim.config.gel import fit_gel, gel_sizes_given
        from tacsim.geometry.pressing_side import find_pressing_side

        known, files = find_objects(objects, scale)
        model = load_sensor(sensor).model_copy(update={"view": None})
        scene = load_scene("press", [f"preset={preset}", *(set_ or [])])
        own = gel_sizes_given(text.partition("=")[0].split(".") for text in set_ or [])
        scene, said = fit_gel(scene, {"lower": model}, given=own)
        background = model.lighting.background
        if isinstance(background, str):
            place = f"sensor/background{Path(background).suffix}"
            files = {**files, place: Path(background).read_bytes()}
            light = model.lighting.model_copy(update={"background": place})
            model = model.model_copy(update={"lighting": light})
        settings = _checked(
            PressSet, seed=seed, objects=known, scene=scene, sensor=model,
            depth=drawn.depth[:2], pose=drawn.pose, tilt=drawn.tilt[:2] if drawn.pose == "random" else (0.0, 0.0),
            shear=drawn.shear[:2], twist=drawn.twist[:2],
        )  # fmt: skip
    if files and scene.indenter is not None:
        name = find_pressing_side(scene.indenter).name
        said = [*said, f"pressing side of each mesh: {name}; --set indenter.roll and indenter.pitch choose another"]
    for words in said:
        notes.print(words)
    command = _command("press", given)
    _run(PressJob(settings, count), out, files, command, workers, ray)


def episodes(
    rig: Annotated[str, typer.Argument(help="A simulated rig (sim), or the path of its file.")],
    out: OutSet,
    policy: Annotated[
        str, typer.Option(help="scripted, random, grip, learned, FILE.onnx, FILE.csv, or package.module:name.")
    ] = "scripted",
    task: Annotated[
        str | None, typer.Option(help="squeeze, reposition, knead, or a path.", show_default="the rig's own")
    ] = None,
    count: Count = 10,
    steps: Annotated[
        int | None, typer.Option(min=1, max=1_000_000, help="Of each.", show_default="the task's; else 40")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the first; each has one more than the one before.")] = 0,
    randomise: Annotated[
        str | None, typer.Option(help="What differs from episode to episode: squeeze, reposition, or a path.")
    ] = None,
    workers: Workers = None,
    ray: Ray = None,
    set_: Overrides = None,
) -> None:
    """Play episodes on a simulated rig: DIR/episode-00000.mcap and so on, for tacsim export lerobot DIR.

    Killed anywhere, the same command goes on.

    Example: tacsim collect episodes sim --task squeeze --randomise squeeze --count 20 --out episodes
    """
    given = [
        ("--task", task, None), ("--policy", policy, None), ("--count", str(count), None),
        ("--steps", None if steps is None else str(steps), None), ("--seed", str(seed), None),
        ("--randomise", randomise, None), *(("--set", text, None) for text in set_ or []), ("--out", str(out), None),
    ]  # fmt: skip
    with busy("loading"):
        from robot.collect.episodes import EpisodeJob, EpisodeSet
        from tacsim.config import load
        from tacsim.models.randomisation import Randomisation

        drawn = None if randomise is None else load(Randomisation, randomise)
        settings = _checked(
            EpisodeSet, rig=rig, task=task, overrides=tuple(set_ or ()), policy=policy, steps=steps, seed=seed,
            randomise=drawn,
        )  # fmt: skip
        job = EpisodeJob(settings, count)
        job.check()
    _run(job, out, {}, _command(f"episodes {shlex.quote(rig)}", given), workers, ray)


def _run(
    job: PressJob | EpisodeJob, out: Path, files: dict[str, bytes], command: str, workers: int | None, ray: str | None
) -> None:
    """Makes the set, shows how far it is, and says how it went."""
    quiet_time = 10.0  # without a terminal, how far it is is told so often [s]
    import time

    from robot.collect.collect import collect as make
    from robot.collect.workers import Stopped
    from tacsim.compute.threads import cores

    begun = said = time.perf_counter()
    there = 0
    with Interrupt() as interrupt, one_bar("starting (the first run compiles the kernels)") as bar:

        def tell(done: int, total: int) -> None:
            nonlocal there, said
            there = done
            bar.say(job.settings.kind)
            bar.count(done, total)
            if not notes.is_terminal and (done == total or time.perf_counter() - said > quiet_time):
                said = time.perf_counter()
                notes.print(f"{done} of {total}")

        try:
            number = workers if workers is not None else cores()
            done = make(job, out, files, command, workers=number, cluster=ray, report_progress=tell, stop=interrupt)
        except Stopped:
            complain(f"stopped by a signal; {there} of {job.count} are there. The same command goes on")
            raise typer.Exit(interrupt.exit_code) from None
    _say(done, job.count, time.perf_counter() - begun, out)
    if len(done.failures) == job.count:
        complain(f"all failed; the first: {done.failures[min(done.failures)]}")
        raise typer.Exit(FAILED)


def _say(done: Collected, count: int, seconds: float, out: Path) -> None:
    if done.made:
        spent = sum(done.seconds.values())
        parts = ", ".join(f"{name} {100 * part / spent:.0f} %" for name, part in done.seconds.most_common())
        results.print(
            f"{done.made} made in {seconds:.1f} s by {len(done.workers)}: {done.made / seconds:.2f} a second; "
            f"of their time {parts}; {done.bytes / 2**20:.1f} MiB written in {done.writing_seconds:.1f} s"
        )
    if done.failures:
        notes.print(f"{len(done.failures)} of {count} failed; why is in {out / 'failures.jsonl'}")
    results.print(str(out))


def _checked(model: Any, **values: Any) -> Any:
    """A model of these values. Raises SetError in the words of what it refuses."""
    from pydantic import ValidationError

    from robot.collect.job import SetError

    try:
        return model(**values)
    except ValidationError as refused:
        first = refused.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise SetError(f"{where}: {first['msg']}".removeprefix(": ").replace("Value error, ", "")) from None


def _command(what: str, given: Sequence[tuple[str, str | None, str | None]]) -> str:
    """The command that makes this set, without options that have their defaults."""
    words = [shlex.join((option, value)) for option, value, default in given if value is not None and value != default]
    return " ".join(["tacsim collect", what, *words])

"""`tacsim collect`: sets of presses and of episodes, many at once; sample presses."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer

from robot.cli.options import (
    TASK_POLICIES,
    OptionGroup,
    Out,
    Overrides,
    Preset,
    RayCluster,
    SensorModel,
    complete_names,
    quantity_parser,
    require_packages,
    with_option_groups,
)
from robot.cli.output import busy, counted, new_directory, notes, one_bar, print_files, print_json, results, writing
from robot.cli.terminal import EXIT_FAILED, Interrupt, print_error

if TYPE_CHECKING:
    from robot.collect.collect import Collected
    from robot.collect.episodes import EpisodeJob
    from robot.collect.presses import PressJob

collect = typer.Typer(
    no_args_is_help=True, help="Make sets of presses or of episodes, many at once; or sample presses."
)

NUMBER = re.compile(r"\s*[-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?\s*")

Count = Annotated[int, typer.Option(min=1, max=10_000_000, help="Number; more than before extends a set.")]
OutSet = Annotated[
    Path,
    typer.Option("--out", metavar="DIR", help="Folder of the set; a set that this command has started is continued."),
]
Seed = Annotated[int, typer.Option(min=0, help="Same seed, same set.")]
Workers = Annotated[
    int | None, typer.Option(min=1, max=1024, help="Processes on this machine.", show_default="one per core")
]


class Range(NamedTuple):
    """Minimum and maximum [SI], and the text of the option."""

    low: float
    high: float
    text: str


def range_parser(kind: str) -> Callable[[str], Range]:
    """Parser of an option that is one length or angle, or a range of them: "0.1..1.0mm"."""

    def parse(text: str) -> Range:
        first, dots, second = str(text).partition("..")
        if not dots:
            second = first
        elif NUMBER.fullmatch(first):
            first += NUMBER.sub("", second, count=1)
        low, high = (quantity_parser(kind)(part.strip()) for part in (first, second))
        if low > high:
            raise typer.BadParameter(f"'{text}' goes from the larger to the smaller value; write {second}..{first}")
        return Range(low, high, text)

    return parse


def range_option(kind: str, help_: str) -> Any:
    return typer.Option(parser=range_parser(kind), metavar="RANGE", help=help_)


class PressRanges(OptionGroup):
    """Options whose values are drawn for each press."""

    depth: Annotated[Any, range_option("length", "Depth below the surface of the untouched gel.")] = "0.1..1.0mm"
    pose: Annotated[
        Literal["random", "centred"], typer.Option(help="random: at any position in the image, with any rotation.")
    ] = "random"
    tilt: Annotated[Any, range_option("angle", "Angle to the vertical in random directions; of random poses.")] = (
        "0..5deg"
    )
    shear: Annotated[Any, range_option("length", "Then slide in a random direction.")] = "0"
    twist: Annotated[Any, range_option("angle", "Then rotate about the vertical.")] = "0"


@with_option_groups
def press(
    out: OutSet,
    *,
    objects: Annotated[
        str,
        typer.Option(metavar="DIR|shapes", help="A folder of STL, OBJ or PLY files, or the twenty shapes of tacsim."),
    ] = "shapes",
    drawn: PressRanges,
    count: Count = 100,
    seed: Seed = 0,
    sensor: SensorModel = "ideal",
    preset: Preset = "standard",
    scale: Annotated[
        float | None,
        typer.Option(
            help="Metres per unit of the mesh files; guessed from their size if left out.", show_default=False
        ),
    ] = None,
    workers: Workers = None,
    ray: RayCluster = None,
    set_: Overrides = None,
) -> None:
    """Press objects on a gel at random poses: images with heights, forces, contact, flow and poses, in parquet files.

    Load it with `datasets.load_dataset("DIR")`; DIR/README.md describes it. After an interruption, the same command
    continues. --set changes the scene (tacsim schema scene). Needs the extra 'export'.

    Example: tacsim collect press --depth 0.1..1.0mm --count 500 --out presses
    """
    given = [
        ("--objects", objects, None), ("--depth", drawn.depth.text, None), ("--pose", drawn.pose, None),
        ("--tilt", drawn.tilt.text if drawn.pose == "random" else None, None), ("--shear", drawn.shear.text, "0"),
        ("--twist", drawn.twist.text, "0"),
        ("--count", str(count), None), ("--seed", str(seed), None), ("--sensor", sensor, None),
        ("--preset", preset, None),
        *([] if scale is None else [("--scale", f"{scale:g}", None)]),
        *(("--set", text, None) for text in set_ or []), ("--out", str(out), None),
    ]  # fmt: skip
    require_packages("tacsim collect press", "export", "pyarrow")
    with busy("loading"):
        from robot.collect.objects import find_objects
        from robot.collect.presses import PressJob, PressSet
        from tacsim.config import load_scene, load_sensor
        from tacsim.config.gel import fit_gel, overridden_gel_sizes
        from tacsim.geometry.pressing_side import find_pressing_side

        known, files = find_objects(objects, scale)
        model = load_sensor(sensor).model_copy(update={"view": None})
        scene = load_scene("press", [f"preset={preset}", *(set_ or [])])
        own = overridden_gel_sizes(text.partition("=")[0].split(".") for text in set_ or [])
        scene, said = fit_gel(scene, {"lower": model}, given=own)
        background = model.lighting.background
        if isinstance(background, str):
            place = f"sensor/background{Path(background).suffix}"
            files = {**files, place: Path(background).read_bytes()}
            light = model.lighting.model_copy(update={"background": place})
            model = model.model_copy(update={"lighting": light})
        settings = _validate(
            PressSet, seed=seed, objects=known, scene=scene, sensor=model,
            depth=drawn.depth[:2], pose=drawn.pose, tilt=drawn.tilt[:2] if drawn.pose == "random" else (0.0, 0.0),
            shear=drawn.shear[:2], twist=drawn.twist[:2],
        )  # fmt: skip
    if files and scene.indenter is not None:
        name = find_pressing_side(scene.indenter).name
        said = [*said, f"pressing side of each mesh: {name}; --set indenter.roll and indenter.pitch choose another"]
    for words in said:
        notes.print(words)
    command = _command_line("press", given)
    _make_set(PressJob(settings, count), out, files, command, workers, ray)


def episodes(
    rig: Annotated[
        str,
        typer.Argument(help="A simulated rig (sim), or the path of its file.", autocompletion=complete_names("rig")),
    ],
    out: OutSet,
    policy: Annotated[
        str,
        typer.Option(
            help="scripted, random, teacher, grip, learned, FILE.onnx, FILE.csv, or package.module:name.",
            autocompletion=complete_names(words=(*TASK_POLICIES, "random", "teacher")),
        ),
    ] = "scripted",
    task: Annotated[
        str | None,
        typer.Option(
            help="A shipped task (`tacsim list task`), or the path of a task file.",
            show_default="the rig's own",
            autocompletion=complete_names("task"),
        ),
    ] = None,
    count: Count = 10,
    steps: Annotated[
        int | None, typer.Option(min=1, max=1_000_000, help="Of each episode.", show_default="the task's; else 40")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the first episode; each next one adds 1.")] = 0,
    randomise: Annotated[
        str | None,
        typer.Option(
            help="A shipped randomisation of the episodes (`tacsim list randomisation`), or its path.",
            autocompletion=complete_names("randomisation"),
        ),
    ] = None,
    workers: Workers = None,
    ray: RayCluster = None,
    set_: Overrides = None,
) -> None:
    """Run episodes on a simulated rig: DIR/episode-00000.mcap and so on, for tacsim export lerobot DIR.

    After an interruption, the same command continues.

    Example: tacsim collect episodes sim --task squeeze --randomise squeeze --count 20 --out episodes
    """
    given = [
        ("--task", task, None), ("--policy", policy, None), ("--count", str(count), None),
        ("--steps", None if steps is None else str(steps), None), ("--seed", str(seed), None),
        ("--randomise", randomise, None), *(("--set", text, None) for text in set_ or []), ("--out", str(out), None),
    ]  # fmt: skip
    with busy("loading"):
        from robot.collect.episodes import EpisodeJob, EpisodeSet
        from tacsim.config import load_model
        from tacsim.models.randomisation import Randomisation

        drawn = None if randomise is None else load_model(Randomisation, randomise)
        settings = _validate(
            EpisodeSet, rig=rig, task=task, overrides=tuple(set_ or ()), policy=policy, steps=steps, seed=seed,
            randomise=drawn,
        )  # fmt: skip
        job = EpisodeJob(settings, count)
        job.check()
    _make_set(job, out, {}, _command_line(f"episodes {shlex.quote(rig)}", given), workers, ray)


def experts(
    task: Annotated[
        str,
        typer.Argument(
            help="A task of the benchmark (tacsim benchmark tasks), or the path of a task file.",
            autocompletion=complete_names("benchmark"),
        ),
    ],
    out: OutSet,
    count: Count = 200,
    pictures: Annotated[
        bool, typer.Option("--pictures/--no-pictures", help="Without pictures it loads faster: numbers alone.")
    ] = True,
    workers: Workers = None,
    ray: RayCluster = None,
    set_: Overrides = None,
) -> None:
    """Make a data set of expert episodes of a task, for LeRobot and Hugging Face datasets, with a card and its hash.

    The teacher acts, by the ground truth; no episode is one of a test. DIR/episodes has the recordings, DIR/lerobot the
    data set. After an interruption, the same command continues. Needs the extra 'export'.

    Example: tacsim collect experts squeeze --out experts-squeeze
    """
    require_packages("tacsim collect experts", "export", "pyarrow")
    with busy("loading"):
        from robot.collect.episodes import EpisodeJob
        from robot.collect.experts import DATA_SET, RECORDINGS, expert_set, write_expert_data

        job = EpisodeJob(expert_set(task, tuple(set_ or ())), count)
        job.check()
    given = [("--count", str(count), None), *(("--set", text, None) for text in set_ or []), ("--out", str(out), None)]
    command = _command_line(f"experts {shlex.quote(task)}{'' if pictures else ' --no-pictures'}", given)
    _make_set(job, out / RECORDINGS, {}, command, workers, ray, is_last=False)
    with counted("exporting") as on_step:
        digest = write_expert_data(out, task, command, on_step, pictures=pictures)
    results.print(f"{out / DATA_SET}  SHA-256 of data/: {digest}")
    print_json({"sha256": digest}, [out / DATA_SET])


def samples(out: Out = None) -> None:
    """Draw sample presses of a ball, to try tacsim calibrate sensor and tacsim compare without a sensor.

    sensor/ holds the pictures of a simulated DIGIT with camera noise, simulation/ the same presses in a coarser
    simulation without noise; lengths.json has the true lengths. They are the same each time.

    Example: tacsim collect samples --out samples
    """
    folder = new_directory(out, "samples")
    with busy("loading (the first run compiles the kernels, up to half a minute)"):
        from robot.studies.sample_presses import BALL_RADIUS, PRESSES, SENSOR, SERIES, draw_samples, sample_lengths
        from tacsim.config import load_sensor
        from tacsim.record.images import encode_png

        model = load_sensor(SENSOR)
    with writing(folder), counted("drawing presses") as on_press:
        for name in SERIES:
            (folder / name).mkdir()
        for name, image in draw_samples(on_press):
            (folder / f"{name}.png").write_bytes(encode_png(image))
        lengths = sample_lengths(model)
        (folder / "lengths.json").write_text(json.dumps(lengths, indent=1) + "\n", encoding="utf-8")
    files = [*(folder / name for name in SERIES), folder / "lengths.json"]
    print_files(*files)
    print_json({"lengths": lengths}, files)
    sensor, simulation = (shlex.quote(str(folder / name)) for name in SERIES)
    notes.print(
        f'calibrate: tacsim calibrate sensor {sensor} --ball-diameter "{2e3 * BALL_RADIUS:g} mm" --pixel-pitch '
        f'"{1e3 * model.geometry.pixel_pitch:g} mm" --depth "press_0.png={PRESSES[0][2]:g} mm"'
    )
    notes.print(f"compare: tacsim compare {simulation} {sensor}")


def _make_set(
    job: PressJob | EpisodeJob,
    out: Path,
    files: dict[str, bytes],
    command: str,
    workers: int | None,
    ray: str | None,
    *,
    is_last: bool = True,
) -> None:
    """Makes the set, and shows its progress and a summary. is_last: nothing follows, so the JSON document is its."""
    report_interval = 10.0  # between two lines of progress without a terminal [s]
    import time

    from robot.collect.collect import collect as make
    from robot.collect.workers import Stopped
    from tacsim.compute.threads import core_count

    begun = said = time.perf_counter()
    done_count = 0
    with Interrupt() as interrupt, one_bar("starting (the first run compiles the kernels)") as bar:

        def report_progress(done: int, total: int) -> None:
            nonlocal done_count, said
            done_count = done
            bar.set_text(job.settings.kind)
            bar.set_progress(done, total)
            if not notes.is_terminal and (done == total or time.perf_counter() - said > report_interval):
                said = time.perf_counter()
                notes.print(f"{done} of {total}")

        try:
            number = workers if workers is not None else core_count()
            done = make(
                job, out, files, command, workers=number, cluster=ray, report_progress=report_progress, stop=interrupt
            )
        except Stopped:
            print_error(
                f"stopped by a signal; {done_count} of {job.count} are finished. Run the same command again to continue"
            )
            raise typer.Exit(interrupt.exit_code) from None
    _print_summary(done, job.count, time.perf_counter() - begun, out, is_last)
    if len(done.failures) == job.count:
        print_error(f"all failed; the first error: {done.failures[min(done.failures)]}")
        raise typer.Exit(EXIT_FAILED)


def _print_summary(done: Collected, count: int, seconds: float, out: Path, is_last: bool) -> None:
    if done.made:
        spent = sum(done.seconds.values())
        parts = ", ".join(f"{name} {100 * part / spent:.0f} %" for name, part in done.seconds.most_common())
        results.print(
            f"{done.made} made in {seconds:.1f} s by {len(done.workers)}: {done.made / seconds:.2f} per second; "
            f"of their time {parts}; {done.bytes / 2**20:.1f} MiB written in {done.writing_seconds:.1f} s"
        )
    if done.failures:
        notes.print(f"{len(done.failures)} of {count} failed; the reasons are in {out / 'failures.jsonl'}")
    if not is_last:
        return
    results.print(str(out))
    figures = {"count": count, "made": done.made, "seconds": seconds, "workers": len(done.workers), "bytes": done.bytes}
    print_json({**figures, "failures": done.failures}, [out])


def _validate(model: Any, **values: Any) -> Any:
    """A model of these values. Raises SetError with the first message of the validation."""
    from pydantic import ValidationError

    from robot.collect.workers import SetError

    try:
        return model(**values)
    except ValidationError as refused:
        first = refused.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise SetError(f"{where}: {first['msg']}".removeprefix(": ").replace("Value error, ", "")) from None


def _command_line(what: str, given: Sequence[tuple[str, str | None, str | None]]) -> str:
    """The command that makes this set, without options at their defaults."""
    words = [shlex.join((option, value)) for option, value, default in given if value is not None and value != default]
    return " ".join(["tacsim collect", what, *words])

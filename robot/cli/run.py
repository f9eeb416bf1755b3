"""`tacsim run` and `tacsim replay`: an episode, and the report of one."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from robot.cli.options import TASK_POLICIES, Out, Overrides, complete_names
from robot.cli.output import (
    Bar,
    busy,
    counted,
    new_directory,
    notes,
    one_bar,
    print_files,
    print_json,
    report_mesh_measuring,
    require_writable,
    results,
    warn,
    writing,
)
from robot.cli.terminal import EXIT_FAILED, Interrupt, ask_operator, print_error, require_operator

if TYPE_CHECKING:
    from robot.deploy.control_loop import EpisodeSetup
    from robot.export.rerun_view import LiveView
    from tacsim.config import LoadedRig
    from tacsim.interface import Policy, RigSpec
    from tacsim.record.episode import Episode, EpisodeMeta, Step
    from tacsim.record.writer import Recorder
    from tacsim.rig import Rig
    from tacsim.tasks import Task

STARTING = "starting (the first run compiles the kernels, up to half a minute)"
OPENING = "opening the rig"
MAX_REPLAY_STEPS = 1_000_000  # of a replay, which ends with its recording


def run(
    rig: Annotated[
        str,
        typer.Argument(
            help="A shipped rig (`tacsim list rig`), or the path of its file.",
            autocompletion=complete_names("rig"),
        ),
    ] = "sim",
    task: Annotated[
        str | None,
        typer.Option(
            help="A shipped task (`tacsim list task`), the path of a task file, or package.module:name.",
            show_default="the rig's own",
            autocompletion=complete_names("task"),
        ),
    ] = None,
    policy: Annotated[
        str | None,
        typer.Option(
            help="scripted, grip, learned (the shipped one), FILE.onnx, a motion (FILE.csv), or package.module:name.",
            show_default="scripted; grip without a task",
            autocompletion=complete_names(words=TASK_POLICIES),
        ),
    ] = None,
    steps: Annotated[
        int | None, typer.Option(min=0, help="Number of control steps.", show_default="the task's; else 40")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same episode.")] = 0,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Hardware: connect, observe, measure periods and record, but send no motion."),
    ] = False,
    film: Annotated[
        Path | None, typer.Option(metavar="FILE.mp4|gif", help="Also write a film of it (mp4: extra 'video').")
    ] = None,
    view: Annotated[bool, typer.Option("--view", help="Show it live in Rerun (extra 'viz').")] = False,
    save_view: Annotated[
        Path | None,
        typer.Option("--save-view", metavar="FILE.rrd", help="Write a file for Rerun's viewer during the run."),
    ] = None,
    set_: Overrides = None,
    out: Out = None,
) -> None:
    """Run one episode: a policy on a rig. Records it and writes a report.

    Ctrl-C, SIGTERM or a lost terminal ends the episode after the present step; all finished steps are saved and
    reported.

    Example: tacsim run sim --task squeeze --steps 30 --out runs/first
    """
    default_steps = 40  # number of steps without a task and without a recording
    from robot.open import load_with_task

    views = [None] * view + [save_view] * (save_view is not None)
    _require_possible(policy, film, views)
    sys.path.append(str(Path.cwd()))  # --policy mine:act finds mine.py here, as with `python -m`; last on the path
    loaded = load_with_task(rig, task, set_ or [])
    for words in loaded.notes:
        notes.print(words)
    own_task = loaded.config.task
    if not dry_run:
        require_operator(loaded.config)
    folder = new_directory(out, loaded.config.name if own_task is None else own_task.kind)
    if steps is None:
        endless = MAX_REPLAY_STEPS if loaded.config.clock == "replay" else default_steps
        steps = endless if own_task is None else own_task.steps
    name = policy if policy is not None else ("grip" if own_task is None else "scripted")
    with Interrupt() as interrupt:
        failed = _run(loaded, name, steps, seed, folder, interrupt, dry_run, views, film)
        if interrupt():
            print_error("stopped by a signal before the last step; all finished steps are saved")
            raise typer.Exit(interrupt.exit_code)
    if failed:
        raise typer.Exit(EXIT_FAILED)


def _require_possible(policy: str | None, film: Path | None, views: Sequence[Path | None]) -> None:
    """Refuses what cannot be done, before a file is read or a rig opened. Raises typer.BadParameter, PolicyNotFound,
    CannotOpen, NoFilm."""
    from robot.deploy.policy import require_policy_name

    if policy is not None:
        require_policy_name(policy)
    for file in views:
        if file is not None and file.suffix != ".rrd":
            raise typer.BadParameter(f"{file} must end in .rrd, as the viewer's files do", param_hint="--save-view")
    if film is not None:
        _require_film(film, "--film")
    if views:
        from robot.export.rerun_view import require_viewer

        for file in views:
            require_viewer(file)


def _run(
    loaded: LoadedRig,
    policy: str,
    steps: int,
    seed: int,
    folder: Path,
    interrupt: Interrupt,
    dry_run: bool,
    views: Sequence[Path | None],
    film: Path | None,
) -> bool:
    """Runs and reports the episode; returns True if it or its recording failed. The folder is made when the episode
    starts, so a run that cannot start leaves none."""
    with busy("loading"):
        from robot.deploy.control_loop import EpisodeSetup
        from robot.deploy.policy import load_policy, require_fit, training_notes
        from robot.open import open_rig
        from tacsim.physics.failure.dump import dump_to_folder
        from tacsim.record.writer import Recorder
        from tacsim.tasks import make_task
    begun = STARTING if loaded.config.scene is not None else OPENING
    if not notes.is_terminal:
        notes.print(begun)
    task = None if loaded.config.task is None else make_task(loaded.config.task)
    setup = EpisodeSetup(
        policy, seed, {"rig.yaml": loaded.text.encode()}, loaded.config.canonical, loaded.config.records_body
    )
    recorder: Recorder | None = None
    fitting: list[Policy] = []
    scene = loaded.config.scene
    simulated = [scene] if scene is not None and loaded.config.clock in ("sim", "mujoco") else []

    def fit(spec: RigSpec) -> None:
        fitting.append(load_policy(policy, task, spec, loaded.config.canonical))
        require_fit(loaded.config.name, spec, fitting[0], policy, task)
        for words in training_notes(fitting[0], policy, simulated):
            warn(words)

    with (
        dump_to_folder(folder / "diverged"),
        one_bar(begun) as bar,
        report_mesh_measuring(bar.set_text, begun),
        open_rig(loaded, confirm=ask_operator, dry_run=dry_run, check=fit, report=bar.set_text) as rig,
        ExitStack() as stack,
    ):

        def record(meta: EpisodeMeta) -> Recorder:
            nonlocal recorder
            with writing(folder, new=True):
                file = Recorder(folder / "episode.mcap", meta, pitch=loaded.config.canonical.pitch)
                recorder = stack.enter_context(file)
            return recorder

        watched = _open_views(rig.spec, loaded, views, stack)
        episode, failure = _run_steps(rig, fitting[0], task, steps, setup, record, interrupt, bar, watched)
    lost = ""
    if recorder is not None and (recorder.error or recorder.dropped):
        why = recorder.error or "the disk was too slow"
        lost = f"{recorder.path} holds {recorder.written} of {recorder.written + recorder.dropped} steps: {why}"
    for problem in filter(None, (failure, lost)):
        print_error(problem)
    if recorder is None or not episode.steps:
        return True
    episode.dropped = recorder.dropped
    _write_report(episode, folder, [folder / "episode.mcap"], film)
    return bool(failure or lost)


def _open_views(spec: RigSpec, loaded: LoadedRig, files: Sequence[Path | None], stack: ExitStack) -> list[LiveView]:
    """Opens a viewer for None, a file for each path. The stack closes them and reports steps that they did not show."""
    if not files:
        return []
    from robot.export.rerun_view import LiveView

    def close(view: LiveView, name: str) -> None:
        view.close()
        if view.ended:
            notes.print(f"{name} ended before the episode did")
        elif view.left_out:
            notes.print(f"{name} omitted {view.left_out} steps, because it was too slow")

    views = []
    for file in files:
        views.append(LiveView(spec, loaded.config, file))
        stack.callback(close, views[-1], "the viewer" if file is None else str(file))
    return views


def _run_steps(
    rig: Rig,
    policy: Policy,
    task: Task | None,
    steps: int,
    setup: EpisodeSetup,
    record: Callable[[EpisodeMeta], Recorder],
    interrupt: Interrupt,
    bar: Bar,
    views: Sequence[LiveView],
) -> tuple[Episode, str]:
    """Runs the episode with a progress bar; returns it and the error that ended it early ("" without an error)."""
    from robot.deploy.control_loop import EpisodeFailed, run_episode
    from robot.deploy.policy import describe_outside
    from tacsim.record.episode import TRAINING_DISTANCE

    is_reported = False

    def show(step: Step) -> None:
        nonlocal is_reported
        if not is_reported and step.info.get(TRAINING_DISTANCE, 0.0) > 1.0:
            is_reported = True
            warn(f"step {step.index}: policy '{setup.policy}': {describe_outside(policy)}")
        bar.set_text(task.config.kind if task else rig.name)
        bar.set_progress(step.index, None if steps == MAX_REPLAY_STEPS else steps)

    def watch(*observed: Any) -> None:
        for each in views:
            each(*observed)

    try:
        episode = run_episode(
            rig, policy, task, steps, setup=setup, recorder=record, on_step=show, watch=watch, stop=interrupt
        )
    except EpisodeFailed as failed:
        return failed.episode, str(failed)
    return episode, ""


def replay(
    file: Annotated[Path, typer.Argument(help="An episode.mcap, complete or cut off.")],
    out: Out = None,
) -> None:
    """Write the report of a recorded episode again. Nothing is executed.

    Example: tacsim replay runs/first/episode.mcap
    """
    folder = new_directory(out, "replay")
    with busy("reading"):
        from tacsim.record.episode import EpisodeError
        from tacsim.record.reader import read_episode

        episode = read_episode(file)
    if not episode.complete:
        notes.print(f"The recording was cut off; {len(episode.steps)} steps could be read.")
    if not episode.steps:
        raise EpisodeError(f"{file}: no step can be read, there is nothing to show")
    folder.mkdir(parents=True)
    _write_report(episode, folder, [])


def film(
    file: Annotated[Path, typer.Argument(metavar="EPISODE", help="An episode.mcap; one that was cut off will do.")],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.mp4|gif", help="The film.", show_default="EPISODE with .gif")
    ] = None,
) -> None:
    """Make a film of a recorded episode: the body between its gels, pictures, force and reward.

    The body is recorded by simulated rigs. An MP4 needs the extra 'video'.

    Example: tacsim film runs/first/episode.mcap --out first.gif
    """
    target = file.with_suffix(".gif") if out is None else out
    _require_film(target, "--out")
    with busy("reading"):
        from tacsim.record.reader import read_episode

        episode = read_episode(file)
    _write_film(episode, target)
    print_files(target)
    print_json({"steps": len(episode.steps)}, [target])


def _require_film(path: Path, option: str) -> None:
    from tacsim.report.film import require_film

    require_film(path)
    require_writable(path, option, new=True)


def _write_film(episode: Episode, path: Path) -> None:
    from robot.rig.recorded import RecordedSurfaces
    from tacsim.report.film import write_film

    with counted("film") as on_frame, writing(path.parent):
        surfaces = RecordedSurfaces(episode.meta)
        write_film(episode, path, surfaces, surfaces.gels, on_frame)


def _write_report(episode: Episode, folder: Path, files: Sequence[Path], film: Path | None = None) -> None:
    """Writes the report, then the film, and prints the table."""
    import json

    from robot.rig.recorded import RecordedSurfaces
    from tacsim.report.report import summary_table, write_report

    with busy("writing the report"), writing(folder):
        surfaces = RecordedSurfaces(episode.meta)
        paths = write_report(episode, folder, surfaces, surfaces.gels)
        stats = json.loads(paths["summary.json"].read_text(encoding="utf-8"))
    for words in surfaces.notes:
        notes.print(words)
    listed = [paths["report.html"], paths["report.png"], *files, paths["summary.json"]]
    if film is not None:
        _write_film(episode, film)
        listed.append(film)
    results.print(summary_table(stats, listed))
    print_json({"summary": stats}, listed)

"""The `tacsim` command: one file for each group of commands. Heavy packages are imported inside the commands."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Callable
from typing import Annotated

import typer

import robot

if "public_names" not in vars(robot):  # asked before other modules are imported, which may be replaced, too
    raise SystemExit(
        f"error: {robot.__file__} is not of tacsim but of another distribution with a package `robot`, such as "
        "robotframework. Use another environment, or: python -m pip uninstall -y robotframework; "
        "python -m pip install --force-reinstall --no-deps tacsim"
    )

from robot.cli.bench import bench
from robot.cli.benchmark import benchmark, draw, fit_blind, rank, table, tasks, verify
from robot.cli.benchmark import compare as compare_policies
from robot.cli.benchmark import run as run_benchmark
from robot.cli.calibrate.lens import lens
from robot.cli.calibrate.poses import hand_eye, latency, touch
from robot.cli.calibrate.sensor import calibrate
from robot.cli.catalogue import list_, new, show
from robot.cli.collect import collect, episodes, experts, samples
from robot.cli.collect import press as press_set
from robot.cli.compare import compare
from robot.cli.doctor import doctor, schema, start
from robot.cli.identify import body, gel, identify
from robot.cli.learn.evaluate import evaluate, transfer
from robot.cli.learn.train import export, policy, policy_range, train
from robot.cli.mock import mock
from robot.cli.options import with_json_option
from robot.cli.recordings import lerobot, recover, view
from robot.cli.run import film, replay, run
from robot.cli.serve import serve
from robot.cli.simulate import debug, press, reproduce
from robot.cli.terminal import Guarded

app = typer.Typer(
    name="tacsim",
    cls=Guarded,
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Example: [bold]tacsim run --task squeeze --out runs/first[/]   "
    "· [bold]--debug[/], anywhere on the line, shows tracebacks.",
)
SEE, ROBOTS, CALIBRATE, LEARN, FILES, DEVELOP = (
    "See: simulate, run, replay",
    "Robots: real and mock hardware",
    "Calibrate: sensors, cameras, materials",
    "Learn: data, policies",
    "Files: names, schemas, recordings",
    "Develop: figures, failures",
)
HEADINGS = {  # of `tacsim --help`, with their commands, both in the order of the page
    SEE: (run, press, replay, film, view),
    ROBOTS: (doctor, start, serve, mock),
    CALIBRATE: (compare,),
    LEARN: (train, evaluate, transfer),
    FILES: (list_, show, new, schema, recover),
    DEVELOP: (bench, reproduce, debug),
}
GROUPS = {
    "calibrate": (calibrate, CALIBRATE, (latency, lens, touch, hand_eye)),
    "identify": (identify, CALIBRATE, (gel, body)),
    "collect": (collect, LEARN, (press_set, episodes, experts, samples)),
    "export": (export, LEARN, (policy, policy_range, lerobot)),
    "benchmark": (benchmark, LEARN, (run_benchmark, tasks, verify, compare_policies, table, rank, draw, fit_blind)),
}


# No result, a result that is JSON anyway, and two commands whose --json names a file
WITHOUT_JSON_OPTION = (mock, serve, schema, bench, evaluate)


def _add_command(group: typer.Typer, command: Callable[..., None], heading: str | None = None) -> None:
    # typer takes the first line of help from the docstring, and the example from the epilog
    text, _, example = (command.__doc__ or "").partition("Example:")
    name = command.__name__.strip("_").replace("_", "-")
    epilog = f"Example: [bold]{example.strip()}[/]"
    given = command if command in WITHOUT_JSON_OPTION else with_json_option(command)
    group.command(name, help=text, epilog=epilog, rich_help_panel=heading)(given)


for heading, commands in HEADINGS.items():
    for command in commands:
        _add_command(app, command, heading)
for name, (group, heading, commands) in GROUPS.items():
    app.add_typer(group, name=name, rich_help_panel=heading)
    for command in commands:
        _add_command(group, command)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib import metadata

        try:
            typer.echo(f"tacsim {metadata.version('tacsim')}")
        except metadata.PackageNotFoundError:
            typer.echo("tacsim, not installed (run from its sources)")
        raise typer.Exit


@app.callback()
def tacsim(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    """A sim-to-real bridge for robots that feel with optical tactile sensors."""


def main() -> None:
    """Entry point of the `tacsim` command."""
    # Imported objects are never freed. A search through them after every 700 new objects takes 10 % of a short
    # command's time; with this threshold it takes 2 % (a press makes 140,000 objects).
    gc.set_threshold(200_000, 20, 20)
    # Matrices are small: on a busy machine several threads would wait for each other, and a calibration would take
    # three times the processor time. NumPy is not loaded yet.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _drop_all_but(sys.argv[1:2])
    app()


def _drop_all_but(words: list[str]) -> None:
    """Removes all commands except the called one, if the first word is its name: preparing all 27 commands takes as
    long as importing NumPy."""
    called = [command for command in app.registered_commands if command.name in words]
    if called:
        app.registered_commands, app.registered_groups = called, []

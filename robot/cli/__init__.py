"""The `tacsim` command: one file for each group of commands. Heavy packages are imported inside the commands."""

from __future__ import annotations

import gc
import os
import sys
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
from robot.cli.calibrate.lens import lens
from robot.cli.calibrate.poses import hand_eye, latency, touch
from robot.cli.calibrate.sensor import calibrate
from robot.cli.catalogue import list_, new, show
from robot.cli.collect import collect, episodes, samples
from robot.cli.collect import press as press_set
from robot.cli.compare import compare
from robot.cli.doctor import doctor, schema, start
from robot.cli.errors import Guarded
from robot.cli.identify import body, gel, identify
from robot.cli.learn import evaluate, export, policy, policy_range, train, transfer
from robot.cli.mock import mock
from robot.cli.recordings import lerobot, recover, view
from robot.cli.run import replay, run
from robot.cli.simulate import debug, press, reproduce

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
app.add_typer(calibrate, name="calibrate")
app.add_typer(collect, name="collect")
app.add_typer(export, name="export")
app.add_typer(identify, name="identify")
COMMANDS = {
    app: (
        run,
        press,
        reproduce,
        replay,
        view,
        recover,
        mock,
        list_,
        show,
        new,
        bench,
        compare,
        debug,
        schema,
        doctor,
        start,
        train,
        evaluate,
        transfer,
    ),
    calibrate: (latency, lens, touch, hand_eye),
    collect: (press_set, episodes, samples),
    export: (policy, policy_range, lerobot),
    identify: (gel, body),
}
for group, commands in COMMANDS.items():
    for command in commands:
        # typer takes the first line of help from the docstring, and the example from the epilog
        text, _, example = (command.__doc__ or "").partition("Example:")
        name = command.__name__.strip("_").replace("_", "-")
        group.command(name, help=text, epilog=f"Example: [bold]{example.strip()}[/]")(command)


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

"""`tacsim schema`, `doctor` and `start`: schemas of files, checks of machine and rig, motion of arms to their start."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from robot.cli.bench import from_checkout, require_checkout
from robot.cli.options import HardwareRig, Overrides, complete_names
from robot.cli.output import SafeConsole, busy, notes, print_json, results
from robot.cli.terminal import Interrupt, ask_operator, has_operator, print_error
from tacsim.models.text import suggest_word

if TYPE_CHECKING:
    from tacsim.models.driver import Check

MARKS = {"ok": "[green]ok[/]", "warn": "[yellow]warn[/]", "fail": "[bold red]fail[/]"}


def _complete_schema() -> list[str]:
    from tacsim.config import KINDS

    return [*KINDS, "bench"]


def schema(
    kind: Annotated[
        str,
        typer.Argument(
            help="What the file describes, for example rig or scene; or bench.", autocompletion=_complete_schema
        ),
    ] = "rig",
) -> None:
    """Print the JSON schema of a configuration file; editors complete and check YAML with it.

    `bench` is the schema of what `tacsim bench --json` writes.

    Example: tacsim schema rig > rig.schema.json
    """
    import json

    from tacsim.config import KINDS, json_schema

    if kind == "bench":
        require_checkout("tacsim schema bench")
        typer.echo(json.dumps(from_checkout("benchmarks.harness.schema").json_schema(), indent=2))
        return
    if kind not in KINDS:
        known = (*KINDS, "bench")
        words = f"no kind '{kind}'; allowed: {', '.join(known)}{suggest_word(kind, known)}"
        raise typer.BadParameter(words, param_hint="KIND")
    typer.echo(json.dumps(json_schema(kind), indent=2))


def doctor(
    rig: Annotated[
        str | None,
        typer.Option(
            "--rig",
            metavar="FILE",
            help="Check this rig instead: arms, their forces, cameras, limits.",
            autocompletion=complete_names("rig"),
        ),
    ] = None,
    set_: Overrides = None,
) -> None:
    """Check Python, packages, OpenCV, Taichi and the machine, or a rig; exit code 1 if something must be repaired.

    Nothing moves: the command reads the state of arms and sends no motion.

    Example: tacsim doctor --rig ur5e
    """
    from robot.doctor import as_json, examine_machine, examine_rig

    if rig is None:
        checks = examine_machine()
    else:
        from robot.open import check_sensors
        from tacsim.config import load_rig

        with busy("checking the rig"):
            config = load_rig(rig, overrides=set_ or []).config
            check_sensors(config)
            checks = examine_rig(config, rig)
    report = as_json(checks)
    print_checks(checks)
    print_json(report)
    raise typer.Exit(0 if report["ok"] else 1)


def print_checks(checks: list[Check]) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for check in checks:
        words = Text(check.found)
        if check.advice:
            words.append(f"\n→ {check.advice}", style="italic")
        table.add_row(MARKS[check.state], check.name, words)
    SafeConsole(quiet=results.quiet).print(table)


def start(
    rig: HardwareRig,
    set_: Overrides = None,
) -> None:
    """Move the arms of a rig from their present position to the start of an episode.

    Shows the position of each arm, offers to zero its force sensor, and moves the arms one after the other, slowly and
    on a straight line in joint space. Every step needs your confirmation at the terminal; Ctrl-C brakes.

    Example: tacsim start my.yaml
    """
    with busy("looking at the rig"):
        from robot.doctor import as_json, examine_arms
        from robot.open import CannotOpen
        from robot.procedures.to_start import Halted, Operator, move_to_start
        from robot.rig.parts import companion_of
        from tacsim.config import load_rig
        from tacsim.models.hardware import UrArmConfig, parts_of

        config = load_rig(rig, overrides=set_ or []).config
    arms = parts_of(config.arms, UrArmConfig)
    if not arms:
        raise CannotOpen(f"rig '{config.name}' has no UR arm: there is nothing to move to its start")
    if not has_operator():
        raise CannotOpen(
            f"rig '{config.name}': no arm moves to its start without a confirmation; run this from a terminal"
        )
    with Interrupt() as interrupt, companion_of(config) as companion:
        of_mocks = {} if companion is None else companion.start_poses
        starts = {**of_mocks, **{name: arm.start.pose for name, arm in arms.items() if arm.start is not None}}
        with busy("looking at the arms"):
            checks = examine_arms(config, of_mocks, rig)
        print_checks(checks)
        try:
            with busy("connecting") as show:
                operator = Operator(
                    lambda question: ask_operator(f"Rig '{config.name}': {question}"),
                    lambda words: notes.print(words),
                    show,
                    interrupt,
                )
                away = move_to_start(config, starts, operator)
        except Halted as halted:
            print_error(str(halted))
            raise typer.Exit(interrupt.exit_code or 1) from None
    print_json({**as_json(checks), "distance_from_start": away})  # [m]
    if any(distance > 5e-3 for distance in away.values()) or not away:
        print_error("not every arm is at its start")
        raise typer.Exit(1)
    notes.print(f"All arms are at their starts. Next: tacsim run {rig} --dry-run")

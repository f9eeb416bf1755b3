"""How the command line says that something went wrong: a message and an exit code, no traceback."""

from __future__ import annotations

import os
from typing import Any

import click
from rich.console import Console
from rich.text import Text
from typer.core import TyperGroup

OURS = {"tacsim", "calibration", "robot"}
UNUSABLE, FAILED, INTERRUPTED = 2, 1, 130  # exit codes: bad configuration or usage, failure, Ctrl-C


class Guarded(TyperGroup):
    """The group of all commands: turns exceptions into messages, unless `--debug` stands somewhere on the line."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        own = args[: args.index("--")] if "--" in args else args
        ctx.meta["tacsim.debug"] = "--debug" in own
        return super().parse_args(ctx, [word for word in own if word != "--debug"] + args[len(own) :])

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            if ctx.meta["tacsim.debug"]:
                raise
            complain("interrupted")
            ctx.exit(INTERRUPTED)
        except (click.ClickException, click.exceptions.Exit, click.Abort):
            raise
        except Exception as error:
            if ctx.meta["tacsim.debug"]:
                raise
            message, code = explain(error)
            complain(message)
            ctx.exit(code)


def explain(error: Exception) -> tuple[str, int]:
    """What to tell a person about `error`, and the exit code."""
    from tacsim.config import ConfigError

    if isinstance(error, ConfigError):
        return str(error), UNUSABLE
    if isinstance(error, OSError):
        where = f"{os.fsdecode(error.filename)}: " if isinstance(error.filename, str | bytes | os.PathLike) else ""
        return f"{where}{error.strerror or error or type(error).__name__}", FAILED
    if type(error).__module__.partition(".")[0] in OURS:
        return str(error) or type(error).__name__, FAILED
    return f"unexpected {type(error).__name__}: {error}\nRun again with --debug for the traceback.", FAILED


def complain(message: str) -> None:
    """Prints an error message on stderr."""
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    console.print(Text("error: ", style="bold red") + Text(message))

"""How the command line says that something went wrong: a message and an exit code, no traceback."""

from __future__ import annotations

import os
from typing import Any

import typer
from rich.text import Text
from typer.core import TyperGroup

from robot.cli.output import SafeConsole
from tacsim.models.text import printable

OURS = {"tacsim", "calibration", "robot"}
UNUSABLE, FAILED, INTERRUPTED = 2, 1, 130  # exit codes: bad configuration or usage, failure, Ctrl-C
# What was named cannot be read or written there, whatever is done
NO_PLACE = (FileExistsError, FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError)
UNTRUSTED = 3  # all was done, but the result is not to be trusted


class Guarded(TyperGroup):
    """The group of all commands: turns exceptions into messages, unless `--debug` stands somewhere on the line."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        own = args[: args.index("--")] if "--" in args else args
        ctx.meta["tacsim.debug"] = "--debug" in own
        return super().parse_args(ctx, [word for word in own if word != "--debug"] + args[len(own) :])

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            complain("interrupted")
            raise typer.Exit(INTERRUPTED) from None
        except Exception as error:
            of_typer = isinstance(error, typer.Abort) or hasattr(error, "exit_code")  # it handles its own
            if of_typer or ctx.meta["tacsim.debug"]:
                raise
            message, code = explain(error)
            complain(message)
            raise typer.Exit(code) from None


def explain(error: Exception) -> tuple[str, int]:
    """What to tell a person about `error`, and the exit code."""
    from calibration.errors import CalibrationError
    from robot.collect.job import SetError
    from robot.deploy.policy import PolicyNotFound
    from robot.open import CannotOpen, CodeNotFound
    from robot.train.run_folder import RunError
    from tacsim.config import ConfigError
    from tacsim.interface import IncompatibleRig
    from tacsim.physics.failure.dump import DumpError
    from tacsim.record.episode import EpisodeError
    from tacsim.tasks.task import BadDraws, GoalOutOfReach

    unusable = (
        BadDraws,
        ConfigError,
        CannotOpen,
        CodeNotFound,
        GoalOutOfReach,
        PolicyNotFound,
        IncompatibleRig,
        CalibrationError,
        DumpError,
        EpisodeError,
        RunError,
        SetError,
    )
    if isinstance(error, unusable):
        return str(error), UNUSABLE
    if _refused(error):
        return str(error), UNUSABLE
    if isinstance(error, ExceptionGroup):
        parts = [explain(part) for part in error.exceptions if isinstance(part, Exception)]
        return "\n".join([error.message, *(message for message, _ in parts)]), FAILED
    if isinstance(error, OSError):
        code = UNUSABLE if isinstance(error, NO_PLACE) else FAILED
        named = isinstance(error.filename, str | bytes | os.PathLike)
        where = f"{printable(os.fsdecode(error.filename))}: " if named else ""
        why = error.strerror or str(error) or type(error).__name__
        if isinstance(error, FileExistsError):
            why = "exists already; nothing is overwritten, name another"
        return f"{where}{why}", code
    if type(error).__module__.partition(".")[0] in OURS:
        return str(error) or type(error).__name__, FAILED
    return f"unexpected {type(error).__name__}: {error}\nRun again with --debug for the traceback.", FAILED


def _refused(error: Exception) -> bool:
    """True for what our own code says of a value, a file or a device that it was given: a bare ValueError or a
    FileNotFoundError in words, and a RuntimeError of the one module that starts Taichi."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    module = str(trace.tb_frame.f_globals.get("__name__", "") if trace is not None else "")
    in_words = type(error) is ValueError or (isinstance(error, FileNotFoundError) and error.errno is None)
    ours = in_words and module.partition(".")[0] in OURS
    return ours or (type(error) is RuntimeError and module == "tacsim.compute.runtime")


def complain(message: str) -> None:
    """Prints an error message on stderr."""
    SafeConsole(stderr=True, soft_wrap=True, highlight=False).print(Text("error: ", style="bold red") + Text(message))

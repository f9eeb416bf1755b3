"""How the command line says that something went wrong: a message and an exit code, no traceback."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import typer
from rich.text import Text
from typer.core import TyperGroup

from robot.cli.output import SafeConsole
from tacsim.models.text import printable_line

OURS = {"tacsim", "calibration", "robot"}
UNUSABLE, FAILED, INTERRUPTED = 2, 1, 130  # exit codes: bad configuration or usage, failure, Ctrl-C
# What was named cannot be read or written there, whatever is done
NO_PLACE = (FileExistsError, FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError)
UNTRUSTED = 3  # all was done, but the result is not to be trusted
UNVERIFIED = 4  # all was done, and nothing checks the lengths that the result is measured in


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
    if _refused(error):
        return str(error), UNUSABLE
    if isinstance(error, ExceptionGroup):
        parts = [explain(part) for part in error.exceptions if isinstance(part, Exception)]
        return "\n".join([error.message, *(message for message, _ in parts)]), FAILED
    if isinstance(error, FileNotFoundError) and not _has_working_directory():
        return "the working directory no longer exists; change to another folder", UNUSABLE
    if isinstance(error, OSError):
        code = UNUSABLE if isinstance(error, NO_PLACE) else FAILED
        named = isinstance(error.filename, str | bytes | os.PathLike)
        where = f"{printable_line(os.fsdecode(error.filename))}: " if named else ""
        why = error.strerror or str(error) or type(error).__name__
        if isinstance(error, FileExistsError):
            why = "exists already; nothing is overwritten, name another"
        return f"{where}{why}", code
    if _ours(type(error).__module__):
        return str(error) or type(error).__name__, FAILED
    return f"unexpected {type(error).__name__}: {error}\nRun again with --debug for the traceback.", FAILED


def _refused(error: Exception) -> bool:
    """True for what our own code says of a value, a file or a device that it was given: a ValueError, ours or raised by
    us, a FileNotFoundError in words, and a RuntimeError of the one module that starts Taichi."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    module = str(trace.tb_frame.f_globals.get("__name__", "") if trace is not None else "")
    if isinstance(error, ValueError):
        return _ours(type(error).__module__) or (type(error) is ValueError and _ours(module))
    if isinstance(error, FileNotFoundError):
        return error.errno is None and _ours(module)
    return type(error) is RuntimeError and module == "tacsim.compute.runtime"


def _has_working_directory() -> bool:
    try:
        Path.cwd()
    except FileNotFoundError:
        return False
    return True


def _ours(module: str) -> bool:
    return module.partition(".")[0] in OURS


def complain(message: str) -> None:
    """Prints an error message on stderr."""
    SafeConsole(stderr=True, soft_wrap=True, highlight=False).print(Text("error: ", style="bold red") + Text(message))

"""Errors on the command line: a message and an exit code, no traceback."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import typer
from rich.text import Text
from typer.core import TyperGroup

from robot.cli.output import SafeConsole
from tacsim.models.text import printable_line, suggest_word

OWN_PACKAGES = {"tacsim", "calibration", "robot"}
EXIT_USAGE, EXIT_FAILED, EXIT_INTERRUPTED = 2, 1, 130  # exit codes: bad configuration or usage, failure, Ctrl-C
# The named path cannot be read or written
PATH_ERRORS = (FileExistsError, FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError)
EXIT_UNTRUSTED = 3  # the command finished, but its result must not be trusted
EXIT_UNVERIFIED = 4  # the command finished, but no measurement checks the length scale of its result


class Guarded(TyperGroup):
    """The group of all commands: converts exceptions to messages, unless the command line contains `--debug`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        own = args[: args.index("--")] if "--" in args else args
        ctx.meta["tacsim.debug"] = "--debug" in own
        return super().parse_args(ctx, [word for word in own if word != "--debug"] + args[len(own) :])

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            print_error("interrupted")
            raise typer.Exit(EXIT_INTERRUPTED) from None
        except typer.BadParameter as error:
            message = error.message.replace("Value error, ", "")  # of the library that checks choices
            suggestion = _suggest_choice(message)
            error.message = f"{message.removesuffix('.') if suggestion else message}{suggestion}"
            raise
        except Exception as error:
            of_typer = isinstance(error, typer.Abort) or hasattr(error, "exit_code")  # typer handles these
            if of_typer or ctx.meta["tacsim.debug"]:
                raise
            message, code = describe_error(error)
            print_error(message)
            raise typer.Exit(code) from None


def _suggest_choice(message: str) -> str:
    """The nearest of the words that an option allows, for typer's message about another word; else an empty text."""
    given, _, choices = message.partition(" is not one of ")
    return suggest_word(given.rpartition(" ")[2].strip("'"), re.findall(r"'([^']+)'", choices))


def describe_error(error: Exception) -> tuple[str, int]:
    """The message for the user about `error`, and the exit code."""
    if _is_user_error(error):
        return str(error), EXIT_USAGE
    if isinstance(error, ExceptionGroup):
        parts = [describe_error(part) for part in error.exceptions if isinstance(part, Exception)]
        return "\n".join([error.message, *(message for message, _ in parts)]), EXIT_FAILED
    if isinstance(error, FileNotFoundError) and not _has_working_directory():
        return "the working directory no longer exists; change to another folder", EXIT_USAGE
    if isinstance(error, OSError):
        code = EXIT_USAGE if isinstance(error, PATH_ERRORS) else EXIT_FAILED
        named = isinstance(error.filename, str | bytes | os.PathLike)
        where = f"{printable_line(os.fsdecode(error.filename))}: " if named else ""
        why = error.strerror or str(error) or type(error).__name__
        if isinstance(error, FileExistsError):
            why = "exists already; nothing is overwritten, give another path"
        return f"{where}{why}", code
    if _is_own_module(type(error).__module__):
        return str(error) or type(error).__name__, EXIT_FAILED
    return f"unexpected {type(error).__name__}: {error}\nRun again with --debug for the traceback.", EXIT_FAILED


def _is_user_error(error: Exception) -> bool:
    """True for an error about a value, a file or a device that the user gave: a ValueError that is defined or raised in
    our packages, a FileNotFoundError with a text, and a RuntimeError of the module that starts Taichi."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    module = str(trace.tb_frame.f_globals.get("__name__", "") if trace is not None else "")
    if isinstance(error, ValueError):
        return _is_own_module(type(error).__module__) or (type(error) is ValueError and _is_own_module(module))
    if isinstance(error, FileNotFoundError):
        return error.errno is None and _is_own_module(module)
    return type(error) is RuntimeError and module == "tacsim.compute.runtime"


def _has_working_directory() -> bool:
    try:
        Path.cwd()
    except FileNotFoundError:
        return False
    return True


def _is_own_module(module: str) -> bool:
    return module.partition(".")[0] in OWN_PACKAGES


def print_error(message: str) -> None:
    """Prints an error message on stderr."""
    SafeConsole(stderr=True, soft_wrap=True, highlight=False).print(Text("error: ", style="bold red") + Text(message))

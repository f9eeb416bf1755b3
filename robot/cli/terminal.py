"""The terminal: errors as a message and an exit code, without traceback; questions to the operator; and Ctrl-C, SIGTERM
or a lost terminal (SIGHUP) as a request to stop."""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any, Self

import typer
from rich.text import Text
from typer.core import TyperGroup

from robot.cli.output import SafeConsole, pause_displays
from tacsim.models.text import escape_text, printable_line, suggest_word

if TYPE_CHECKING:
    from tacsim.models.rig import RigConfig

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


SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class Interrupt:
    """In its block, a signal stops the command. Open it in the main thread.

    Before the first call of this object, the first signal raises KeyboardInterrupt, which ends slow work and motions at
    once. After the first call, the signal is only stored: the next call returns True, and the caller ends its work in
    order. A second signal always raises KeyboardInterrupt. A KeyboardInterrupt that leaves the block becomes the exit
    of the command.

    on_signal: called in the signal handler when a signal is stored, for work that does not ask this object.
    """

    def __init__(self, on_signal: Callable[[], None] = lambda: None) -> None:
        self._on_signal = on_signal
        self._signal: int | None = None
        self._was_called = False
        self._before: dict[int, Any] = {}

    def __call__(self) -> bool:
        """True once a signal has come: the stop flag of the control loop."""
        self._was_called = True
        return self._signal is not None

    @property
    def exit_code(self) -> int:
        """128 + signal, as in shells; 0 without a signal."""
        return 0 if self._signal is None else 128 + self._signal

    def _handle_signal(self, number: int, frame: FrameType | None) -> None:
        first = self._signal is None
        if first:
            self._signal = number
            _redirect_lost_terminal()
        if not (first and self._was_called):
            raise KeyboardInterrupt
        self._on_signal()

    def __enter__(self) -> Self:
        for number in SIGNALS:
            before = signal.getsignal(number)
            if number in (signal.SIGINT, signal.SIGTERM) or before != signal.SIG_IGN:  # `nohup` ignores SIGHUP
                self._before[number] = signal.signal(number, self._handle_signal)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if self._signal is not None and isinstance(error, KeyboardInterrupt | typer.Abort):
            print_error(f"stopped by {signal.Signals(self._signal).name}")
            raise typer.Exit(self.exit_code) from None


def _redirect_lost_terminal() -> None:
    """Redirects output to os.devnull if the terminal is gone: otherwise printing would fail, and end the remaining
    work."""
    for stream in (1, 2):
        try:
            os.write(stream, b"")
        except OSError:
            with suppress(OSError), Path(os.devnull).open("wb") as nowhere:
                os.dup2(nowhere.fileno(), stream)


class NoAnswer(RuntimeError):
    """The input ended before the operator answered a question."""


def has_operator() -> bool:
    """True if the operator can read and answer questions: input and error output are a terminal."""
    return all(
        stream is not None and stream.isatty() for stream in (sys.stdin, sys.stderr)
    )  # None: the stream is closed


def ask_operator(question: str, *, default: bool = False) -> bool:
    """Asks the operator at the terminal; returns False without a terminal.

    Progress displays are paused, and text that was typed before the question is discarded. Raises KeyboardInterrupt at
    a signal, NoAnswer at the end of the input (Ctrl-D).
    """
    if not has_operator():
        return False
    signals: list[int] = []

    def end(number: int, frame: FrameType | None) -> None:
        signals.append(number)
        before[number](number, frame)
        raise KeyboardInterrupt

    before = {number: handler for number in SIGNALS if callable(handler := signal.getsignal(number))}
    with pause_displays():
        try:
            for number in before:
                signal.signal(number, end)
            _discard_typed_input()
            return typer.confirm(escape_text(question), default=default, err=True)
        except typer.Abort:
            if signals:
                raise KeyboardInterrupt from None
            raise NoAnswer(f"no answer to the question: {question}") from None
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def require_operator(config: RigConfig) -> None:
    """Raises CannotOpen, before any motion, if a real arm would move and there is no terminal to confirm it."""
    from robot.open import CannotOpen

    if has_real_arm(config) and not has_operator():
        raise CannotOpen(
            f"rig '{config.name}': a real arm approaches only after the operator has confirmed; run this from a "
            "terminal, without redirecting input or error output"
        )


def has_real_arm(config: RigConfig) -> bool:
    """True if an arm of the rig is not a mock; a manufacturer's simulator counts as real."""
    return any(arm.is_real for arm in config.arms.values())


def _discard_typed_input() -> None:
    with suppress(ImportError):  # Windows has no termios
        import termios

        termios.tcflush(sys.stdin, termios.TCIFLUSH)

"""Output of commands: folders, files, messages, progress and tables."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from tacsim.models.text import escape_text, printable_line

if TYPE_CHECKING:
    from rich.progress import Progress
    from rich.status import Status


class SafeConsole(Console):
    """A console that prints control characters as text. Names and texts from files, recordings and devices must not
    move the cursor, change colours or reverse the writing direction."""

    @property
    def options(self) -> ConsoleOptions:
        min_columns = 60  # with fewer, a table would lose values; the terminal breaks its lines instead
        found = super().options
        return found.update_width(max(found.max_width, min_columns))

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=escape_text(segment.text, allowed="\n\t"))


results = SafeConsole(markup=False, emoji=False, highlight=False, soft_wrap=True)  # stdout: results
notes = SafeConsole(
    stderr=True, markup=False, emoji=False, highlight=False, soft_wrap=True
)  # stderr: progress and notes


def choose_json(context: typer.Context, chosen: bool) -> bool:
    """Callback of the option --json: `print_json` prints, and texts for people are left out of stdout until the command
    ends."""
    results.quiet = chosen
    context.call_on_close(_print_texts_again)
    return chosen


def choose_json_file(context: typer.Context, file: Path | None) -> Path | None:
    """Callback of the option --json FILE: the file `-` is stdout, as for `choose_json`."""
    choose_json(context, file == Path("-"))
    return file


def _print_texts_again() -> None:
    results.quiet = False


def print_json(document: Any, files: Iterable[Path] | None = None) -> None:
    """With --json prints the result of the command as one JSON document, otherwise nothing.

    document: dictionaries, sequences, dataclasses, pydantic models and arrays; NaN and infinity become null.
    files: written files; they are added to a dictionary as `files`.
    """
    if not results.quiet:
        return
    import json

    from pydantic_core import to_json

    if files is not None:
        document = {**document, "files": [str(path) for path in files]}
    text = to_json(document, inf_nan_mode="null", fallback=lambda value: value.tolist())
    typer.echo(json.dumps(json.loads(text), indent=1))  # ASCII: a name from a file must not control the terminal


def new_directory(out: Path | None, what: str) -> Path:
    """The new folder for the results of `what`. Raises typer.BadParameter before the work starts if it exists or cannot
    be made."""
    folder = Path("runs") / f"{datetime.now():%Y%m%d-%H%M%S}-{what}" if out is None else out
    if folder.exists():
        raise typer.BadParameter(
            f"{folder} exists already; name a new folder, nothing is overwritten", param_hint="--out"
        )
    new = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise typer.BadParameter(
            f"{folder} cannot be made ({error.strerror}); name a folder that can be written", param_hint="--out"
        ) from None
    finally:
        for place in new:
            with suppress(OSError):
                place.rmdir()
    return folder


def require_writable(file: Path | None, option: str, *, new: bool = False) -> None:
    """Raises typer.BadParameter before the work starts for a file that cannot be written, or that exists if `new`."""
    if file is None:
        return
    there = next(place for place in (file, *file.absolute().parents) if place.exists())
    if new and there == file:
        raise typer.BadParameter(f"{file} exists already; name a new file", param_hint=option)
    if there.is_dir() == (there == file) or not os.access(there, os.W_OK):
        raise typer.BadParameter(f"{file} cannot be written; name another file", param_hint=option)


@contextmanager
def writing(folder: Path, *, new: bool = False) -> Iterator[Path]:
    """Makes `folder` if it is missing. `new`: raises FileExistsError if another process has made it. An OSError in the
    block without a file name gets the name of the folder: the error of a full disk names no file."""
    try:
        folder.mkdir(parents=True, exist_ok=not new)
        yield folder
    except OSError as failure:
        if failure.filename is None:
            failure.filename = str(folder)
        raise


_drawn_displays: list[Progress | Status] = []  # progress displays on the terminal


@contextmanager
def _register_display(display: Progress | Status) -> Iterator[None]:
    _drawn_displays.append(display)
    try:
        yield
    finally:
        _drawn_displays.remove(display)


@contextmanager
def pause_displays() -> Iterator[None]:
    """Stops progress displays in the block, so that a text for the operator stays on the screen."""
    for display in _drawn_displays:
        display.stop()
    try:
        yield
    finally:
        for display in _drawn_displays:
            display.start()


@contextmanager
def progress() -> Iterator[Progress]:
    """A progress bar on stderr; without a terminal it prints nothing."""
    from rich import progress as rich

    columns = (
        rich.TextColumn("{task.description}"),
        rich.BarColumn(),
        rich.MofNCompleteColumn(),
        rich.TimeElapsedColumn(),
        rich.TimeRemainingColumn(),
    )
    with (
        rich.Progress(*columns, console=notes, transient=True, disable=not notes.is_terminal) as bar,
        _register_display(bar),
    ):
        yield bar


class Bar:
    """One row of a progress bar."""

    def __init__(self, bar: Progress, words: str) -> None:
        self._bar, self._row = bar, bar.add_task(words, total=None)

    def set_text(self, words: str) -> None:
        """Sets the description of the present work."""
        self._bar.update(self._row, description=escape_text(words))

    def set_progress(self, done: int, total: int | None) -> None:
        """Sets the number of finished steps and of all steps; None if that number is unknown."""
        self._bar.update(self._row, completed=done, total=total)

    def report(self, words: str, done: int, total: int) -> None:
        """Sets description and progress."""
        self.set_text(words)
        self.set_progress(done, total)


@contextmanager
def one_bar(words: str) -> Iterator[Bar]:
    """A progress bar of one row."""
    with progress() as bar:
        yield Bar(bar, words)


@contextmanager
def counted(words: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar, as a callback that takes the number of finished steps and of all steps."""
    with one_bar(words) as bar:
        yield bar.set_progress


@contextmanager
def busy(words: str) -> Iterator[Callable[[str], None]]:
    """Reports slow work: on a terminal by a spinner, whose text the yielded function changes; otherwise by one line."""
    if notes.is_terminal:
        with notes.status(words) as status, _register_display(status):
            yield lambda now: status.update(escape_text(now))
    else:
        notes.print(words)
        yield lambda now: None


@contextmanager
def report_mesh_measuring(report: Callable[[str], None], after: str) -> Iterator[None]:
    """Reports progress in the block if measuring the distances of a mesh takes longer than 1 s: on a terminal by
    `report`, which gets the text `after` at the end; otherwise once, as a line."""
    progress_delay = 1.0  # from the start until progress is reported [s]
    from tacsim.geometry.tiles import report_tiles

    began: dict[str, float] = {}
    printed: set[str] = set()

    def report_tile(path: str, done: int, total: int) -> None:
        if done == 0:
            began[path] = time.monotonic()
        elif time.monotonic() - began[path] > progress_delay:
            words = f"measuring the distances from {printable_line(path)}: {done} of {total} parts"
            report(words)
            if not notes.is_terminal and path not in printed:
                notes.print(words)
            printed.add(path)
            if done == total - 1:
                report(after)

    with report_tiles(report_tile):
        yield


def print_files(*paths: Path) -> None:
    """Prints paths, one per line."""
    for path in paths:
        results.print(printable_line(str(path)))


def warn(words: str) -> None:
    """Prints a warning that the user must check before trusting the result."""
    notes.print(f"look at this: {words}")


def show_table(
    title: str,
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    left: Collection[int] = (),
    width: int | None = None,
) -> None:
    """Prints a table on stdout; columns are right-aligned, except those with a number in `left`. Brackets, which
    contain units, are printed unchanged."""
    from rich.table import Table

    table = Table(box=None, padding=(0, 1), title=Text(title), title_justify="left")
    for number, column in enumerate(columns):
        table.add_column(Text(column), justify="left" if number in left else "right")
    for row in rows:
        table.add_row(*map(Text, row))
    SafeConsole(width=width, highlight=False, quiet=results.quiet).print(table, crop=False)

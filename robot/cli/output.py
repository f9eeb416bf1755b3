"""Where a command writes, and how it shows that it is at work."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from tacsim.models.text import escape_text, printable_line

if TYPE_CHECKING:
    from rich.progress import Progress
    from rich.status import Status


class SafeConsole(Console):
    """A console that shows control characters instead of obeying them. What a command prints may hold names and texts
    of files, recordings and devices, which must not move the cursor, change colours or turn the writing round."""

    @property
    def options(self) -> ConsoleOptions:
        min_columns = 60  # columns: in fewer a table loses its values; the terminal breaks its lines instead
        found = super().options
        return found.update_width(max(found.max_width, min_columns))

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=escape_text(segment.text, kept="\n\t"))


results = SafeConsole(markup=False, emoji=False, highlight=False, soft_wrap=True)  # stdout: what the command found
notes = SafeConsole(stderr=True, markup=False, emoji=False, highlight=False, soft_wrap=True)  # stderr: what it is doing


def new_directory(out: Path | None, what: str) -> Path:
    """The folder to be made for the results of `what`. Raises typer.BadParameter if there is one already, or none can
    be made there: better now than after the work."""
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
    """Raises typer.BadParameter for a file that cannot be written, or with `new` is there: better now than after the
    work."""
    if file is None:
        return
    there = next(place for place in (file, *file.absolute().parents) if place.exists())
    if new and there == file:
        raise typer.BadParameter(f"{file} exists already; name a new file", param_hint=option)
    if there.is_dir() == (there == file) or not os.access(there, os.W_OK):
        raise typer.BadParameter(f"{file} cannot be written; name another file", param_hint=option)


@contextmanager
def writing(folder: Path, *, new: bool = False) -> Iterator[Path]:
    """Makes `folder` where it is missing; `new`: raises FileExistsError when someone else just made it. An OSError in
    the block that names no file names it: a disk that fills up in the middle of a write says nothing of where."""
    try:
        folder.mkdir(parents=True, exist_ok=not new)
        yield folder
    except OSError as failure:
        if failure.filename is None:
            failure.filename = str(folder)
        raise


_shown: list[Progress | Status] = []  # what is drawn again and again on the terminal


@contextmanager
def _drawn(shown: Progress | Status) -> Iterator[None]:
    _shown.append(shown)
    try:
        yield
    finally:
        _shown.remove(shown)


@contextmanager
def paused() -> Iterator[None]:
    """Nothing is drawn meanwhile: what a person shall read stays on the screen."""
    for shown in _shown:
        shown.stop()
    try:
        yield
    finally:
        for shown in _shown:
            shown.start()


@contextmanager
def progress() -> Iterator[Progress]:
    """A progress bar on stderr; on no terminal it is silent."""
    from rich import progress as rich

    columns = (
        rich.TextColumn("{task.description}"),
        rich.BarColumn(),
        rich.MofNCompleteColumn(),
        rich.TimeElapsedColumn(),
        rich.TimeRemainingColumn(),
    )
    with rich.Progress(*columns, console=notes, transient=True, disable=not notes.is_terminal) as bar, _drawn(bar):
        yield bar


class Bar:
    """One row of a progress bar."""

    def __init__(self, bar: Progress, words: str) -> None:
        self._bar, self._row = bar, bar.add_task(words, total=None)

    def say(self, words: str) -> None:
        """What is being done."""
        self._bar.update(self._row, description=escape_text(words))

    def count(self, done: int, total: int | None) -> None:
        """How many steps are done, and of how many; None: nobody knows."""
        self._bar.update(self._row, completed=done, total=total)

    def report(self, words: str, done: int, total: int) -> None:
        """Both."""
        self.say(words)
        self.count(done, total)


@contextmanager
def one_bar(words: str) -> Iterator[Bar]:
    """A progress bar of one row."""
    with progress() as bar:
        yield Bar(bar, words)


@contextmanager
def counted(words: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar, as what takes (steps done, steps in all)."""
    with one_bar(words) as bar:
        yield bar.count


@contextmanager
def busy(words: str) -> Iterator[Callable[[str], None]]:
    """Says what takes long; on a terminal with a spinner, which can be given other words, else as one line."""
    if notes.is_terminal:
        with notes.status(words) as status, _drawn(status):
            yield lambda now: status.update(escape_text(now))
    else:
        notes.print(words)
        yield lambda now: None


@contextmanager
def measuring(say: Callable[[str], None], after: str) -> Iterator[None]:
    """In the block it is said how far the measuring of a mesh is that takes longer than QUIET: on a terminal by `say`,
    which then says `after`, else once, as a line."""
    quiet_time = 1.0  # [s] what takes longer says how far it is
    from tacsim.geometry.tiles import report_tiles

    began: dict[str, float] = {}
    told: set[str] = set()

    def tell(path: str, done: int, total: int) -> None:
        if done == 0:
            began[path] = time.monotonic()
        elif time.monotonic() - began[path] > quiet_time:
            words = f"measuring the distances from {printable_line(path)}: {done} of {total} parts"
            say(words)
            if not notes.is_terminal and path not in told:
                notes.print(words)
            told.add(path)
            if done == total - 1:
                say(after)

    with report_tiles(tell):
        yield


def say_files(*paths: Path) -> None:
    """Prints paths, one a line."""
    for path in paths:
        results.print(printable_line(str(path)))


def warn(words: str) -> None:
    """What a person should look at before trusting the result."""
    notes.print(f"look at this: {words}")


def show_table(
    title: str,
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    left: Collection[int] = (),
    width: int | None = None,
) -> None:
    """Prints a table on stdout; columns are flush right, except those with a number in `left`. Brackets are shown as
    they are: they hold units."""
    from rich.table import Table

    table = Table(box=None, padding=(0, 1), title=Text(title), title_justify="left")
    for number, column in enumerate(columns):
        table.add_column(Text(column), justify="left" if number in left else "right")
    for row in rows:
        table.add_row(*map(Text, row))
    SafeConsole(width=width, highlight=False).print(table, crop=False)

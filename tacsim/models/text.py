"""Texts from outside (names in files and recordings, answers of devices), made fit for a terminal."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable
from itertools import islice
from pathlib import Path


def escape_text(text: str, allowed: str = "") -> str:
    """`text` with control characters, and those that turn the direction of writing, written out (``\\x1b``), except
    those in `allowed`. What is escaped already stays as it is."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in allowed else c.encode("unicode_escape").decode("ascii") for c in text)


MAX_NAME = 100  # characters of the name of a sensor or an arm


def check_name(name: str, what: str, limit: int = MAX_NAME) -> None:
    """Raises ValueError for a name of a file or a recording that is too long, or holds control characters."""
    shown = f"the {what} name '{printable_line(name, 40)}'"
    if len(name) > limit:
        raise ValueError(f"{shown} has {len(name)} characters, at most {limit} are allowed")
    if not name.isprintable():
        raise ValueError(f"{shown} holds control characters")


def printable_line(text: str, limit: int = 600) -> str:
    """`text` for any terminal: one line, control characters escaped, the middle of a very long one left out."""
    text = escape_text(text)
    if len(text) <= limit:
        return text
    return f"{text[: limit // 2]} ... {text[-limit // 2 :]}"


def millimetres(*lengths: float, digits: str = ".4g") -> str:
    """Lengths [m] for a message: "4 x 3.5 mm"."""
    return " x ".join(f"{1e3 * length:{digits}}" for length in lengths) + " mm"


def suggest_word(word: str, allowed: Iterable[str]) -> str:
    """ "; did you mean 'x'?" when one of `allowed` is close to `word`, else an empty text."""
    near = _nearest_word(word, allowed)
    return "" if near is None else f"; did you mean '{near}'?"


def suggest_file(path: Path, endings: Collection[str] = ()) -> str:
    """Where to look instead of a missing `path`: the file with the nearest name, else some files with one of these
    endings (".yaml"), in its folder; or that the folder is missing. Begins with "; "; empty if there is nothing to
    say."""
    max_read, max_listed = 10_000, 4
    folder = path.parent
    try:
        names = sorted(each.name for each in islice(folder.iterdir(), max_read) if not each.name.startswith("."))
    except OSError:
        return "" if folder.exists() else f"; there is no folder '{printable_line(str(folder))}' either"
    by_stem = {Path(name).stem: name for name in names}  # equal endings do not make two names similar
    if (near := _nearest_word(path.stem, by_stem)) is not None:
        return f"; did you mean '{printable_line(str(folder / by_stem[near]))}'?"
    fitting = [str(folder / name) for name in names if Path(name).suffix.lower() in endings]
    shown = [*fitting[:max_listed], *["..."] * (len(fitting) > max_listed)]
    return f"; files there: {printable_line(', '.join(shown))}" if shown else ""


def _nearest_word(word: str, allowed: Iterable[str]) -> str | None:
    if len(word) > 100:  # comparison takes quadratic time, and no allowed word is that long
        return None
    by_lower = {name.lower(): name for name in allowed}
    close = difflib.get_close_matches(word.lower(), by_lower, n=1, cutoff=0.6)
    if not close and len(word) > 2:  # "simulation" for "sim", and "mod" for "modelling-clay"
        close = [
            name
            for name in by_lower
            if len(name) > 2 and (word.lower().startswith(name) or name.startswith(word.lower()))
        ]
    return by_lower[close[0]] if close else None

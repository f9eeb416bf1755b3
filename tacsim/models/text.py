"""Texts from outside (names in files and recordings, answers of devices), made fit for a terminal."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def escape_text(text: str, kept: str = "") -> str:
    """`text` with control characters, and those that turn the direction of writing, written out (``\\x1b``), except
    those in `kept`. What is escaped already stays as it is."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in kept else c.encode("unicode_escape").decode("ascii") for c in text)


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
    if len(word) > 100:  # comparison takes quadratic time, and no allowed word is that long
        return ""
    by_lower = {name.lower(): name for name in allowed}
    close = difflib.get_close_matches(word.lower(), by_lower, n=1, cutoff=0.6)
    return f"; did you mean '{by_lower[close[0]]}'?" if close else ""

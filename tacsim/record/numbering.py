"""Matches frames of one recording to rows of another, by their numbers if both have numbers."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tacsim.record.episode import EpisodeError

DIGITS = re.compile(r"[0-9]+")


@dataclass(frozen=True, slots=True)
class Numbering:
    """Frames of a sensor or rows of an arm's table, in order."""

    source: str  # for errors
    count: int
    numbers: tuple[int | None, ...] | None  # one for each; None: not numbered
    reference: int | None = None  # position of the picture without contact that the rig file names


def numbers_in_names(stems: Sequence[str]) -> tuple[int | None, ...] | None:
    """The number in each picture's name: the group of digits in which the names differ; of several groups (a counter
    and a time stamp), the one with the smallest range. None for a name with another pattern. None as a whole if names
    have no such number, or two have the same."""
    patterns = [DIGITS.sub("#", stem.lower()) for stem in stems]
    pattern, frequency = Counter(patterns).most_common(1)[0]
    if frequency <= len(stems) / 2 or "#" not in pattern:
        return None
    values = [
        [int(part) for part in DIGITS.findall(stem)] if of == pattern else None
        for stem, of in zip(stems, patterns, strict=True)
    ]
    columns = list(zip(*(each for each in values if each is not None), strict=True))
    spans = {k: max(column) - min(column) for k, column in enumerate(columns) if len(set(column)) == len(column)}
    if not spans:
        return None
    chosen = min(spans, key=lambda k: (spans[k], -k))
    return tuple(None if each is None else each[chosen] for each in values)


def match_numbers(sensors: Mapping[str, Numbering], arms: Mapping[str, Numbering]) -> dict[str, list[int]]:
    """Positions of the items of each source, by name, in the order of the clock's ticks; empty for a single source.

    Numbered sources are matched by numbers: each frame of a sensor must have a partner in all other sources; rows of an
    arm without a picture are left out. If one source is not numbered, all must have the same count. Raises
    EpisodeError.
    """
    together = {**sensors, **arms}
    if len(together) < 2:
        return {}
    kept = {name: _without_reference(each) for name, each in together.items()}
    if any(each.numbers is None for each in together.values()):
        _require_counts([(together[name], len(items)) for name, items in kept.items()])
        return kept
    numbered = {name: _places_by_number(together[name], items) for name, items in kept.items()}
    first = next(iter(sensors))
    wanted = list(numbered[first])
    for name in together:
        missing = [number for number in wanted if number not in numbered[name]]
        more = [] if name in arms else [number for number in numbered[name] if number not in numbered[first]]
        if missing or more:
            raise _unmatched_error(together[first], together[name], missing, more, list(numbered[name]))
    return {name: [numbers[number] for number in wanted] for name, numbers in numbered.items()}


def _without_reference(of: Numbering) -> list[int]:
    """Positions of all items, without a reference picture that has no number."""
    skipped = of.reference if of.numbers is not None and of.reference is not None else None
    if skipped is not None and of.numbers is not None and of.numbers[skipped] is not None:
        skipped = None  # part of the series, such as its first picture
    return [place for place in range(of.count) if place != skipped]


def _places_by_number(of: Numbering, items: Sequence[int]) -> dict[int, int]:
    """Position of each item by its number. Raises EpisodeError for an item without a number."""
    assert of.numbers is not None
    found = {number: place for place in items if (number := of.numbers[place]) is not None}
    if len(found) < len(items):
        raise EpisodeError(
            f"{of.source}: {len(items) - len(found)} of {len(items)} names have no number like the others', so it is "
            "not known which row of the table they belong to; move them out of the folder"
        )
    return found


def _require_counts(found: Sequence[tuple[Numbering, int]]) -> None:
    counts = {count for _, count in found}
    if len(counts) == 1:
        return
    words = [f"{of.source} has {count}{_describe_gaps(of)}" for of, count in found]
    raise EpisodeError(
        f"not the same number of frames and rows: {'; '.join(words)}. Which belong together is not known; give each "
        "picture a number in its name and the table a column `frame` with these numbers, or make the counts equal"
    )


def _describe_gaps(of: Numbering) -> str:
    """Text with the numbers that are missing between the first and the last."""
    present = {number for number in of.numbers or () if number is not None}
    if not present or max(present) - min(present) >= 2 * len(present):  # every tenth frame, or time stamps
        return ""
    missing = [number for number in range(min(present), max(present)) if number not in present]
    return f" (missing in its numbers: {_list_numbers(missing)})" if missing else ""


def _unmatched_error(
    first: Numbering, other: Numbering, missing: Sequence[int], more: Sequence[int], present: Sequence[int]
) -> EpisodeError:
    parts = [f"{first.source} has number {_list_numbers(missing)}, which {other.source} lacks"] if missing else []
    parts += [f"{other.source} has number {_list_numbers(more)}, which {first.source} lacks"] if more else []
    return EpisodeError(
        f"{'; '.join(parts)} (its numbers go from {min(present)} to {max(present)}). Frames and rows belong together "
        "by number: give both the same numbers, or leave out what has no partner"
    )


def _list_numbers(numbers: Sequence[int]) -> str:
    max_named = 8  # numbers in an error
    more = f" and {len(numbers) - max_named} more" if len(numbers) > max_named else ""
    return ", ".join(map(str, numbers[:max_named])) + more

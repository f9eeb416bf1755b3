"""Decisions have one form, and the measurements behind decisions and pages have pages of their own."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
DECISIONS = sorted((DOCS / "decisions").glob("*.md"))
MEASUREMENTS = sorted((DOCS / "measurements").glob("*.md"))
HEADINGS = ["Status", "Context", "Decision", "Consequences"]
MAX_LINES = 60
MAX_LINE_LENGTH = 150  # of a line that is not a table row: the limit of lines would mean nothing without it
STATUS = re.compile(r"(Accepted|Proposed|Rejected|Superseded by \[decision \d+\]\(\d{4}-[\w-]+\.md\))[.;]")


def sections_of(text: str) -> dict[str, str]:
    """The text below each heading of second level, in order."""
    parts = re.split(r"^## +(.+?) *$", text, flags=re.MULTILINE)
    return dict(zip(parts[1::2], (part.strip() for part in parts[2::2]), strict=True))


def problems_of(text: str, number: int) -> list[str]:
    """What is wrong with the form of a decision; empty if nothing is."""
    lines = text.splitlines()
    sections = sections_of(text)
    found = []
    if not re.match(rf"# {number}\. \S", text):
        found.append(f"does not begin with '# {number}. TITLE'")
    if list(sections) != HEADINGS:
        found.append(f"has the headings {list(sections)}, not {HEADINGS}")
    found += [f"says nothing below '{heading}'" for heading, body in sections.items() if not body]
    if not STATUS.match(sections.get("Status", "")):
        found.append("its status does not begin with 'Accepted.', 'Proposed.', 'Rejected.' or 'Superseded by [...]'")
    if len(lines) > MAX_LINES:
        found.append(f"has {len(lines)} lines, more than {MAX_LINES}: move its measurements to docs/measurements/")
    found += [
        f"line {index} has {len(line)} characters, more than {MAX_LINE_LENGTH}"
        for index, line in enumerate(lines, 1)
        if len(line) > MAX_LINE_LENGTH and not line.startswith("|")
    ]
    return found


@pytest.mark.parametrize("page", DECISIONS, ids=lambda page: page.stem)
def test_decision_has_the_four_headings_on_sixty_lines(page: Path) -> None:
    assert problems_of(page.read_text(encoding="utf-8"), int(page.name[:4])) == []


@pytest.mark.parametrize("page", MEASUREMENTS, ids=lambda page: page.stem)
def test_measurements_and_the_page_they_support_link_to_each_other(page: Path) -> None:
    first_part = page.read_text(encoding="utf-8").partition("\n## ")[0]
    supported = [DOCS / path for path in re.findall(r"\]\(\.\./((?:decisions/)?[\w-]+\.md)", first_part)]
    assert supported, f"{page.name}: its first paragraphs name no decision and no page that it supports"
    assert any(f"measurements/{page.name}" in each.read_text(encoding="utf-8") for each in supported)


GOOD = "# 7. Title\n\n## Status\n\nAccepted.\n\n## Context\n\nA.\n\n## Decision\n\nB.\n\n## Consequences\n\nC.\n"


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("# 7. Title", "# Title", "begin with"),
        ("## Context", "## Why", "headings"),
        ("B.", "", "nothing below 'Decision'"),
        ("Accepted.", "Fine.", "status"),
        ("C.", "C.\n" * 60, "lines"),
        ("C.", "C" * 151, "characters"),
    ],
)
def test_a_wrong_form_is_found(old: str, new: str, problem: str) -> None:
    assert problems_of(GOOD, 7) == []
    (found,) = problems_of(GOOD.replace(old, new), 7)
    assert problem in found

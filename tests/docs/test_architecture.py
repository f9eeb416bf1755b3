"""docs/architecture.md names the rooms that exist, and no others; its links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tools.site.pages import generated_names

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGE = (DOCS / "architecture.md").read_text(encoding="utf-8")
ROOMS = PAGE.partition("## Rooms")[2].partition("\n## ")[0]


ENTRIES = 17  # of a folder, at most
MAX_LINES = 220  # of the page


def named() -> list[str]:
    """Folders in the first column of the tables of rooms."""
    return re.findall(r"^\| `(\w[\w/]*)/` \|", ROOMS, re.MULTILINE)


def folders() -> list[str]:
    """Folders of the three packages that hold modules."""
    return sorted(
        {
            path.parent.relative_to(ROOT).as_posix()
            for package in ("tacsim", "calibration", "robot")
            for path in (ROOT / package).rglob("*.py")
        }
    )


def test_every_room_stands_on_the_page_once() -> None:
    assert sorted(named()) == folders(), (
        "docs/architecture.md: each folder of modules needs one row in the tables of rooms"
    )


def test_the_architecture_is_one_page() -> None:
    assert len(PAGE.splitlines()) <= MAX_LINES


@pytest.mark.parametrize("room", folders())
def test_a_room_is_not_overfull(room: str) -> None:
    skipped = {"__init__.py", "__pycache__", "py.typed"}
    entries = [entry.name for entry in (ROOT / room).iterdir() if entry.name not in skipped]
    assert len(entries) <= ENTRIES, f"{room} holds {len(entries)} entries: make a room of some that belong together"


PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted(DOCS.rglob("*.md"))]
LINK = re.compile(r"\]\((?!https?:)([^)#]*)(?:#([^)]*))?\)")


def anchors(page: Path) -> set[str]:
    """The anchors that a web page of this text has, one a heading."""
    headings = re.findall(r"^#+ +(.+?) *$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    links = LINK.findall(page.read_text(encoding="utf-8"))
    targets = [((page.parent / path) if path else page, anchor) for path, anchor in links]
    generated = {DOCS / name for name in generated_names()}  # pages of the site alone
    targets = [(target, anchor) for target, anchor in targets if target not in generated]
    assert [str(target) for target, _ in targets if not target.exists()] == []
    assert [f"{target.name}#{anchor}" for target, anchor in targets if anchor and anchor not in anchors(target)] == []


def test_decisions_are_numbered_without_gaps() -> None:
    numbers = [int(page.name[:4]) for page in sorted((DOCS / "decisions").glob("*.md"))]
    assert numbers == list(range(1, len(numbers) + 1))

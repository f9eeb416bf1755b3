"""docs/architecture.md names the modules that exist, and no others; its links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGE = (DOCS / "architecture.md").read_text(encoding="utf-8")
ROOMS = PAGE.partition("## Rooms")[2].partition("\n## ")[0]


def named() -> set[str]:
    """Paths in the first column of the tables of rooms. A heading that names a folder holds for its table."""
    found: set[str] = set()
    folder = ""
    for line in ROOMS.splitlines():
        if not line.startswith("|"):
            folder = ""
            continue
        cell = line.split("|")[1]
        if heading := re.match(r" Folder `(.+?)`", cell):
            folder = heading[1]
        else:
            found |= {folder + path for path in re.findall(r"`(.+?)`", cell)}
    return found


def present() -> set[str]:
    """Modules of the three packages; the command line counts as one folder."""
    modules = {
        path.relative_to(ROOT).as_posix()
        for package in ("tacsim", "calibration", "robot")
        for path in (ROOT / package).rglob("*.py")
        if path.name != "__init__.py"
    }
    return {path for path in modules if not path.startswith("robot/cli/")} | {"robot/cli/"}


def test_every_module_has_its_place_on_the_page() -> None:
    assert sorted(present() - named()) == [], "add these to the tables of docs/architecture.md"


def test_the_page_names_nothing_that_is_gone() -> None:
    assert sorted(named() - present()) == [], "take these out of the tables of docs/architecture.md"


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=lambda page: page.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text(encoding="utf-8"))
    assert [link for link in links if not (page.parent / link).exists()] == []


def test_decisions_are_numbered_without_gaps() -> None:
    numbers = [int(page.name[:4]) for page in sorted((DOCS / "decisions").glob("*.md"))]
    assert numbers == list(range(1, len(numbers) + 1))

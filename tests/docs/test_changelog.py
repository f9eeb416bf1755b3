"""CHANGELOG.md has the form of Keep a Changelog, so that tools and people find a version in it."""

from __future__ import annotations

import re
import tomllib
from datetime import date
from itertools import pairwise
from pathlib import Path

from packaging.version import Version

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
KINDS = ["Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"]
HEADINGS = re.findall(r"^## (.+)$", TEXT, re.MULTILINE)
RELEASE = re.compile(r"\[(\d+\.\d+\.\d+)\] - (\d{4}-\d\d-\d\d)")


def releases() -> list[tuple[Version, date]]:
    """Versions and dates of the closed sections, in the order of the file."""
    found = [RELEASE.fullmatch(heading) for heading in HEADINGS[1:]]
    assert None not in found, f"headings after the first are '[VERSION] - YEAR-MONTH-DAY', not {HEADINGS[1:]}"
    return [(Version(each[1]), date.fromisoformat(each[2])) for each in found if each is not None]


def test_unreleased_changes_come_first_then_versions_from_new_to_old() -> None:
    assert HEADINGS[0] == "[Unreleased]"
    assert all(newer > older and on >= before for (newer, on), (older, before) in pairwise(releases()))


def test_the_version_of_the_package_is_not_older_than_the_last_release() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert releases()[0][0] <= Version(version)


def test_each_section_has_known_kinds_of_change_once() -> None:
    for section in re.split(r"^## ", TEXT, flags=re.MULTILINE)[1:]:
        kinds = re.findall(r"^### (.+)$", section, re.MULTILINE)
        assert kinds == [kind for kind in KINDS if kind in kinds], section.partition("\n")[0]
        assert kinds or section.startswith("[Unreleased]")  # which is empty just after a release

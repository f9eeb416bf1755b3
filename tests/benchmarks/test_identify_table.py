"""The table of docs/identify.md is made of what was measured."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import pytest

from benchmarks import identify

ROW = identify.Row(
    "body 3", 2, 88, 795.0,
    {"youngs_modulus": (-0.004, -0.06, 0.05, 50, 50), "friction_lower": (0.2, 0.1, 0.3, 3, 50), "friction_upper": None},
    ["drift"], {"nothing wrong": 0, "drift of 0.2 N": 49}, 50,
)  # fmt: skip
LINE = (
    "| body 3 | 2 | 88 | 795 s | stiffness -0.4 % (-6 to +5; 50 of 50); friction below +20.0 % (+10 to +30, MISSES; "
    "3 of 50); friction above not told | drift | nothing wrong 0, drift of 0.2 N 49 of 50 |"
)


def test_the_page_gets_a_line_for_each_truth_and_keeps_all_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"before\n{identify.BEGIN}\nold\n{identify.END}\nafter\n")
    monkeypatch.setattr(identify, "PAGE", page)
    for kind in ("gel", "body"):
        (tmp_path / f"{kind}-0").mkdir()
        (tmp_path / f"{kind}-0" / identify.ROWS).write_text(json.dumps([asdict(ROW)]))
    identify.main("docs", truths=1, folder=tmp_path)
    table = "\n".join([*identify.HEAD, LINE, LINE])
    assert page.read_text() == f"before\n{identify.BEGIN}\n{table}\n{identify.END}\nafter\n"

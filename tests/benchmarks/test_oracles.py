"""Ours beside solvers that share nothing with it: the rows, and the table that the page makes of them."""

from __future__ import annotations

import pytest

from benchmarks.cases import cylinder, oracles
from benchmarks.harness.schema import Row
from benchmarks.pages import oracles as page


def test_a_ball_is_beside_its_oracle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(oracles.truth, "BALLS", {(4.0, 1.0): oracles.truth.BALLS[4.0, 1.0]})
    monkeypatch.setattr(oracles.truth, "BALL_WITH_FRICTION", {})
    force, contact = oracles.balls("draft", 1)
    assert force.figures["truth_n"] == 0.9497
    assert force.figures["found_n"] == pytest.approx(0.9497, rel=0.03)
    assert contact.figures["found_mm"] == pytest.approx(2.308, rel=0.04)
    assert force.error == pytest.approx(abs(force.figures["found_n"] / 0.9497 - 1) * 100)
    assert force.note == contact.note == ""


def test_a_twist_is_beside_that_of_a_bonded_disc(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(oracles.truth, "PUNCHES", {})
    monkeypatch.setattr(oracles.truth, "TWISTS", {3.0: 1.030})
    (row,) = oracles.punches("draft", 1)
    assert row.figures["truth_nmm"] == pytest.approx(1.030 * 16 / 3 * 0.04899 * 27 * 0.017453, rel=1e-3)
    assert row.error < 5


@pytest.mark.deep
def test_a_cylinders_cycles_flow_and_settle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cylinder, "CYCLES", (1, 2))
    monkeypatch.setattr(cylinder, "FLOWING", (2, 4))
    for row in cylinder.cycled("draft", 1):
        assert row.note == "" and row.error < 4
        assert 0.95 < row.figures["volume_low"] < 1 < row.figures["volume_high"] < 1.03
    second, fourth = cylinder.flowing_cycles("draft", 1)
    assert second.error == 0 and 0 < fourth.error < 10
    assert fourth.figures["volume_off"] < 0.03


def test_the_table_has_a_line_a_case_and_a_column_a_resolution() -> None:
    def row(variant: str, resolution: str, found: float, note: str = "") -> Row:
        return Row(
            group="oracles", case="balls", variant=variant, method="tacsim", resolution=resolution, seconds=1,
            spread=None, cpu_seconds=1, repeats=1, error=1, error_unit="%", against="them", peak_mb=1,
            figures={"found_n": found, "truth_n": 2.0, "volume_low": 0.9}, note=note,
        )  # fmt: skip

    header, lines = page.lines(
        [row("a", "draft", 2.02), row("b", "draft", 1.0, "not settled"), row("a", "standard", 1.98)]
    )
    assert header == ["case", "oracle", "draft", "standard"]
    assert lines == [["a", "2 N", "2.02 (+1.0 %)", "1.98 (-1.0 %)"], ["b", "2 N", "1 (-50.0 %), not settled", ""]]

"""Distributions: what they draw, and what they refuse."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from tacsim.models.randomisation import Distribution, Randomisation

MANY = 4000


def drawn(**distribution: Any) -> np.ndarray:
    random = np.random.default_rng(1)
    made = Distribution(**distribution)
    return np.array([float(made.draw(random).split()[0]) for _ in range(MANY)])


def test_uniform_and_log_uniform_have_their_moments_and_bounds() -> None:
    values = drawn(uniform=("5 mm", "8 mm"))
    assert values.min() >= 5 and values.max() <= 8
    assert values.mean() == pytest.approx(6.5, abs=5 * 3 / np.sqrt(12 * MANY))
    assert values.std() == pytest.approx(3 / np.sqrt(12), rel=0.05)
    values = np.log(drawn(log_uniform=(0.1, 10)))
    assert values.mean() == pytest.approx(0.0, abs=5 * np.log(100) / np.sqrt(12 * MANY))
    assert values.std() == pytest.approx(np.log(100) / np.sqrt(12), rel=0.05)


def test_a_normal_is_that_cut_at_its_bounds() -> None:
    values = drawn(normal=(2.0, 1.0), within=(1.0, 4.0))
    assert values.min() >= 1 and values.max() <= 4
    # A normal distribution cut at -1 and +2 deviations: mean mu + (phi(a) - phi(b)) / (Phi(b) - Phi(a)).
    assert values.mean() == pytest.approx(2.0 + (0.24197 - 0.05399) / (0.97725 - 0.15866), abs=0.06)
    narrow = drawn(normal=(0.0, 1.0), within=(0.0, 1e-9))
    assert narrow.min() >= 0 and narrow.max() <= 1e-9 and narrow.std() > 0


def test_a_choice_draws_each_as_often() -> None:
    made, random = Distribution(choice=("dough", ("9 mm", "8 mm"), 0.5)), np.random.default_rng(1)
    texts = [made.draw(random) for _ in range(MANY)]
    counts = {text: texts.count(text) for text in set(texts)}
    assert set(counts) == {"dough", "[9 mm, 8 mm]", "0.5"}
    assert min(counts.values()) > MANY / 3 - 5 * np.sqrt(MANY * 2 / 9)


def test_units_and_lists_come_through_and_each_element_is_drawn_by_itself() -> None:
    text = Distribution(uniform=(("5 mm", 1, "2 mm"), ("6 mm", 2, "3 mm"))).draw(np.random.default_rng(0))
    first, second, third = text.strip("[]").split(", ")
    assert first.endswith(" mm") and third.endswith(" mm") and " " not in second
    assert len({float(first.split()[0]) - 5, float(second) - 1, float(third.split()[0]) - 2}) == 3
    assert Distribution(log_uniform=("1e-3 MPa", "2e-3 MPa")).draw(np.random.default_rng(0)).endswith(" MPa")


@pytest.mark.parametrize("kind", ["uniform", "log_uniform"])
def test_an_element_whose_bounds_are_one_number_is_that_number(kind: str) -> None:
    """An error of poses aside, but not along z; a size of which one side stays."""
    made = Distribution.model_validate({kind: (("1 mm", "2 mm"), ("4 mm", "2 mm"))})
    first, second = made.draw(np.random.default_rng(0)).strip("[]").split(", ")
    assert 1.0 < float(first.split()[0]) < 4.0
    assert second == "2 mm"
    assert made.ends() == ["[1 mm, 2 mm]", "[4 mm, 2 mm]"]


def test_a_draw_depends_on_seed_number_and_key_alone() -> None:
    values = {"a.b": Distribution(uniform=(0.0, 1.0)), "c": Distribution(uniform=(0.0, 1.0))}
    one = Randomisation(draws=5, values=values).draw_overrides()
    assert one == Randomisation(draws=5, values=values).draw_overrides()
    assert one[:3] == Randomisation(draws=3, values=values).draw_overrides()
    alone = Randomisation(draws=5, values={"c": values["c"]}).draw_overrides()
    assert [each[1:] for each in one] == alone
    assert one != Randomisation(draws=5, seed=1, values=values).draw_overrides()
    assert len({each[0] for each in one}) == 5
    assert one[0][0].startswith("a.b=0.")


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({}, "one of uniform, log_uniform, normal and choice, got none"),
        ({"uniform": (0, 1), "choice": (1,)}, "got uniform and choice"),
        ({"uniform": (2, 1)}, "the least comes first"),
        ({"uniform": ("1 mm", "2 cm")}, "all in one unit"),
        ({"uniform": ("a lot", "more")}, "'a lot' is no number"),
        ({"uniform": (0, "1e999")}, "is no number"),
        ({"uniform": (float("nan"), 1)}, "finite number"),
        ({"uniform": ((1, 2), (3,))}, "lists of one length"),
        ({"uniform": ((1, 2), 3)}, "lists of one length"),
        ({"log_uniform": (0, 1)}, "must be positive"),
        ({"normal": (0, 1)}, "needs bounds"),
        ({"uniform": (0, 1), "within": (0, 1)}, "only that"),
        ({"normal": (0, 0), "within": (-1, 1)}, "must be positive"),
        ({"normal": (5, 1), "within": (-1, 1)}, "mean 5 is not within"),
        ({"choice": ()}, "at least 1"),
        ({"gauss": (0, 1)}, "gauss"),
    ],
)
def test_what_cannot_be_drawn_is_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        Distribution(**wrong)

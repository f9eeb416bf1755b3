"""Quantities: the SI value of every unit, and refusals that say what is allowed."""

from __future__ import annotations

import math
import threading
from typing import Annotated

import pytest

# Subnormal numbers are left out: once Taichi runs in a process it flushes them to zero.
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field, TypeAdapter, ValidationError

from tacsim.models.quantity import UNITS, Config, Length, parse_quantity


@pytest.mark.parametrize(
    ("text", "kind", "si"),
    [
        ("2.92 mm", "length", 2.92e-3),
        ("2.92mm", "length", 2.92e-3),
        (" -5um ", "length", -5e-6),
        ("5 µm", "length", 5e-6),  # micro sign
        ("5 μm", "length", 5e-6),  # Greek mu
        ("1e-3", "length", 1e-3),
        ("0.145 MPa", "pressure", 145e3),
        ("1e2 kPa", "pressure", 1e5),
        ("20 deg", "angle", math.radians(20)),
        ("-90°", "angle", -math.pi / 2),
        ("33 ms", "time", 0.033),
        ("50 mN", "force", 0.05),
        ("10 mm/s", "speed", 0.01),
        ("9810 mm/s^2", "acceleration", 9.81),
        ("1.8 g/cm^3", "density", 1800.0),
        (3, "length", 3.0),
        (0.5, "pressure", 0.5),
    ],
)
def test_si_value(text: str | float, kind: str, si: float) -> None:
    assert parse_quantity(text, kind) == pytest.approx(si, rel=1e-12)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("3 mn", "'3 mn': no unit 'mn' for a length; allowed: a number [m], or a text with its unit (m, mm, cm, um) "
                 "such as '1.5 mm'; did you mean '3 mm'?"),
        ("3 MM", "did you mean '3 mm'?"),
        ("3 kPa", "'3 kPa' is a pressure, not a length"),
        ("3 mm mm", "'3 mm mm' is no length"),
        ("three mm", "is no length"),
        ("1,5 mm", "'1,5 mm' is no length"),
        ("", "is no length"),
        ("nan", "is no length"),
        ("1e999 m", "not finite"),
        (math.inf, "not finite"),
        (10**400, "not finite"),
        (True, "True is no length"),
        (None, "None is no length"),
        ([1.0], "is no length"),
    ],
)  # fmt: skip
def test_refusal_says_what_is_allowed(value: object, message: str) -> None:
    with pytest.raises(ValueError) as caught:
        parse_quantity(value, "length")
    assert message in str(caught.value)
    assert "allowed: a number [m]" in str(caught.value)


@pytest.mark.parametrize(
    "text", ["1" * 1000 + "e ms", "1" * 50_000, " " * 50_000, "1." + "0" * 50_000 + " mm", "m" * 50_000]
)
def test_a_text_of_any_length_is_answered_at_once_and_in_short(text: str) -> None:
    with pytest.raises(
        ValueError, match=r"has \d+ characters, at most 100 are read; allowed: a number \[m\]"
    ) as caught:
        parse_quantity(text, "length")
    assert len(str(caught.value)) < 300


def test_an_ambiguous_unit_gets_no_suggestion() -> None:
    with pytest.raises(ValueError) as caught:
        parse_quantity("3 xm", "length")  # mm, cm and um are equally near
    assert "did you mean" not in str(caught.value)


@given(
    st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False),
    st.sampled_from([(k, u) for k in UNITS for u in UNITS[k]]),
)
def test_every_number_with_every_unit(number: float, kind_and_unit: tuple[str, str]) -> None:
    kind, unit = kind_and_unit
    if math.isfinite(number * UNITS[kind][unit]):
        assert parse_quantity(f"{number!r} {unit}", kind) == number * UNITS[kind][unit]


@given(st.text())
def test_any_text_is_a_finite_number_or_a_value_error(text: str) -> None:
    try:
        number = parse_quantity(text, "length")
    except ValueError as error:
        number, complaint = 0.0, str(error)
    else:
        complaint = "allowed: a number [m]"
    assert math.isfinite(number)
    assert "allowed: a number [m]" in complaint


def test_as_a_field_bounds_hold_for_the_si_value() -> None:
    thickness = TypeAdapter(Annotated[Length, Field(gt=0, le=0.01)])
    assert thickness.validate_python("4 mm") == pytest.approx(0.004)
    for outside in ("0 mm", "-1 mm", "11 mm", 4):
        with pytest.raises(ValidationError):
            thickness.validate_python(outside)
    number, text = thickness.json_schema()["anyOf"]
    assert number == {"type": "number", "exclusiveMinimum": 0, "maximum": 0.01}
    assert text["type"] == "string"
    assert "mm" in text["pattern"]


def test_threads_may_use_a_model_for_the_first_time_at_once() -> None:
    """Validators are built when they are first used."""
    for _ in range(20):

        class Part(Config):
            size: Length
            tag: str = "none"

        class Whole(Config):
            first: Part
            parts: tuple[Part, ...] = ()

        together, found = threading.Barrier(6), []

        def use(together: threading.Barrier = together, found: list[object] = found, whole: type = Whole) -> None:
            together.wait()
            try:
                found.append(whole(first={"size": "2 mm"}, parts=({"size": 1},)).first.size)
            except ValidationError as error:
                found.append(error)

        threads = [threading.Thread(target=use) for _ in range(together.parties)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert found == [2e-3] * together.parties

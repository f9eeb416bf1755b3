"""Physical quantities in configuration files and on the command line: SI numbers, or text with a unit ("2.92 mm")."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, GetJsonSchemaHandler, main
from pydantic_core import CoreSchema, core_schema

# The first unit of each kind is the SI unit that bare numbers have; the second is the one that examples use.
UNITS: dict[str, dict[str, float]] = {
    "length": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "µm": 1e-6, "μm": 1e-6},  # micro sign, Greek mu
    "pressure": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9},
    "angle": {"rad": 1.0, "deg": math.pi / 180.0, "°": math.pi / 180.0},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0},
    "force": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
    "speed": {"m/s": 1.0, "mm/s": 1e-3},
    "acceleration": {"m/s^2": 1.0, "mm/s^2": 1e-3},
    "density": {"kg/m^3": 1.0, "g/cm^3": 1e3},
    "stiffness": {"N/m": 1.0, "N/mm": 1e3},
}
# pydantic leaves the bounds of a validated number under its own names in the JSON schema.
_BOUNDS = {"gt": "exclusiveMinimum", "ge": "minimum", "lt": "exclusiveMaximum", "le": "maximum"}
# No two neighbours of these patterns take the same character: matching takes linear time.
_NUMBER = r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
_QUANTITY = re.compile(rf"({_NUMBER})\s*([^\s0-9.]\S*)?")


def list_units(kind: str) -> str:
    """The units of a kind, for messages: "m, mm, cm, um"."""
    return ", ".join(unit for unit in UNITS[kind] if unit not in ("µm", "μm"))


def parse_quantity(value: Any, kind: str, *, bare: bool = True) -> float:
    """SI value of a number or of a text such as "2.92 mm"; without `bare`, a text but "0" must have its unit. Raises
    ValueError that names the units allowed.

    >>> parse("2.5 mm", "length")
    0.0025
    """
    si, example = list(UNITS[kind])[:2]
    what = f"a number [{si}], or a text with its unit" if bare else "a number with its unit"
    allowed = f"allowed: {what} ({list_units(kind)}) such as '1.5 {example}'"
    if isinstance(value, str):
        number, has_unit = _parse_text(value, kind, allowed)
        if not (bare or has_unit) and number != 0:
            raise ValueError(f"{value!r} has no unit; say '{value.strip()} {example}', or {list_units(kind)}")
        value = number
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"{value!r} is no {kind}; {allowed}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"the {kind} is not finite; {allowed}")
    return number


def _parse_text(text: str, kind: str, allowed: str) -> tuple[float, bool]:
    """SI value, and whether it had a unit."""
    max_characters = 100  # characters of a quantity
    units = UNITS[kind]
    if len(text) > max_characters:
        raise ValueError(
            f"the {kind} {text[:20]!r}... has {len(text)} characters, at most {max_characters} are read; {allowed}"
        )
    match = _QUANTITY.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"{text!r} is no {kind}; {allowed}")
    number, unit = match.groups()
    if not unit:
        return float(number), False
    if unit in units:
        return float(number) * units[unit], True
    for other, theirs in UNITS.items():
        if unit in theirs:
            raise ValueError(f"{text!r} is a {other}, not a {kind}; {allowed}")
    close = [known for known in units if unit.lower() == known.lower()]
    close = close or [known for known in units if _is_one_letter_off(unit, known)]
    hint = f"; did you mean '{number} {close[0]}'?" if len(close) == 1 else ""
    raise ValueError(f"{text!r}: no unit '{unit}' for a {kind}; {allowed}{hint}")


def _is_one_letter_off(unit: str, known: str) -> bool:
    return len(unit) == len(known) > 1 and sum(a != b for a, b in zip(unit, known, strict=True)) == 1


@dataclass(frozen=True, slots=True)
class Quantity:
    """Marks a float field as a quantity: pydantic reads it by :func:`parse_quantity`; the JSON schema has its units."""

    kind: str

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_before_validator_function(
            lambda value: parse_quantity(value, self.kind), handler(source)
        )

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        units = "|".join(re.escape(unit) for unit in UNITS[self.kind])
        text = {"type": "string", "pattern": rf"^\s*{_NUMBER}\s*({units})?\s*$"}
        si = next(iter(UNITS[self.kind]))
        number = {_BOUNDS.get(key, key): value for key, value in handler(schema).items()}
        return {"description": f"{self.kind} [{si}]", "anyOf": [number, text]}


Length = Annotated[float, Quantity("length")]  # [m]
Pressure = Annotated[float, Quantity("pressure")]  # [Pa]
Angle = Annotated[float, Quantity("angle")]  # [rad]
Time = Annotated[float, Quantity("time")]  # [s]
Force = Annotated[float, Quantity("force")]  # [N]
Speed = Annotated[float, Quantity("speed")]  # [m/s]
Acceleration = Annotated[float, Quantity("acceleration")]  # [m/s^2]
Density = Annotated[float, Quantity("density")]  # [kg/m^3]
Stiffness = Annotated[float, Quantity("stiffness")]  # [N/m]


class Config(BaseModel):
    """Base of every configuration model: frozen, unknown keys refused, defaults checked.

    Its validator is built when it is first used, where threads may do that at once: to build all of them takes a tenth
    of a second, and a command uses few.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False, protected_namespaces=(),
        defer_build=hasattr(main, "_rebuild_lock"),  # pydantic 2.14 has it; 2.11 has not
    )  # fmt: skip

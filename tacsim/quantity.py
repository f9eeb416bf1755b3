"""Physical quantities in configuration files and on the command line: SI numbers, or text with a unit ("2.92 mm")."""

from __future__ import annotations

import math
import re
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict

UNITS: dict[str, dict[str, float]] = {
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6},
    "pressure": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9},
    "angle": {"rad": 1.0, "deg": math.pi / 180.0, "°": math.pi / 180.0},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0},
    "force": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
    "speed": {"m/s": 1.0, "mm/s": 1e-3},
    "density": {"kg/m^3": 1.0, "g/cm^3": 1e3},
}
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\S*)\s*")


def parse(value: Any, kind: str) -> float:
    """SI value of a number or of a text such as "2.92 mm". Raises ValueError with the units allowed."""
    units = UNITS[kind]
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError(f"is no {kind}; give a number [{next(iter(units))}] or a text with one of the units {', '.join(units)}")
    if isinstance(value, str):
        match = _NUMBER.fullmatch(value)
        if match is None or (match[2] and match[2] not in units):
            raise ValueError(f"'{value}' is no {kind}; units are {', '.join(units)} (for example '1.5 {next(iter(units))}')")
        value = float(match[1]) * units.get(match[2], 1.0)
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{number} is not finite")
    return number


def _of(kind: str) -> BeforeValidator:
    return BeforeValidator(lambda value: parse(value, kind), json_schema_input_type=float | str)


Length = Annotated[float, _of("length")]  # [m]
Pressure = Annotated[float, _of("pressure")]  # [Pa]
Angle = Annotated[float, _of("angle")]  # [rad]
Time = Annotated[float, _of("time")]  # [s]
Force = Annotated[float, _of("force")]  # [N]
Speed = Annotated[float, _of("speed")]  # [m/s]


class Facts(BaseModel):
    """Base of every configuration model: frozen, unknown keys refused, defaults checked."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False, protected_namespaces=())

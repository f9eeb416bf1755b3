"""Options of several commands, and parsers of quantities on the command line."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property, update_wrapper
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import typer

from robot.cli.output import choose_json


def complete_names(*kinds: str, words: Iterable[str] = ()) -> Callable[[], list[tuple[str, str]]]:
    """Completion in a shell of `words` and of the names of these kinds (of `tacsim list`), with their summaries."""

    def complete() -> list[tuple[str, str]]:
        from tacsim.config.kinds import list_entries

        named = [(entry.name, entry.summary) for kind in kinds for entry in list_entries(kind)]
        return [*((word, "") for word in words), *named]

    return complete


TASK_POLICIES = ("scripted", "grip", "learned")  # names of policies of `tacsim run`
AsJson = Annotated[
    bool, typer.Option("--json", callback=choose_json, help="Print the result as one JSON document instead of text.")
]
Out = Annotated[
    Path | None,
    typer.Option("--out", help="New folder for the results; by default one below runs/.", show_default=False),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a value of the configuration; may be repeated."),
]
Preset = Annotated[Literal["learn", "draft", "standard"], typer.Option("--preset", help="Resolution.")]
SensorModel = Annotated[
    str,
    typer.Option(
        "--sensor",
        help="Its name, the path of a YAML file, or of a calibrated bundle.",
        autocompletion=complete_names("sensor"),
    ),
]
HardwareRig = Annotated[
    str,
    typer.Argument(
        help="A rig of hardware (ur5e, ur5e-one, mock), or the path of its file.", autocompletion=complete_names("rig")
    ),
]
TrainingFile = Annotated[
    str,
    typer.Argument(
        help="A shipped training file (`tacsim list training`), or the path of one.",
        autocompletion=complete_names("training"),
    ),
]
RayCluster = Annotated[
    str | None,
    typer.Option("--ray", metavar="ADDRESS", help="Use a Ray cluster: HOST:PORT, auto, or local (extra cluster)."),
]


def quantity_parser(kind: str, low: float = -math.inf, high: float = math.inf) -> Callable[[str], float]:
    """Parser of an option that is a length, an angle ..., `low` to `high` in SI units. A length other than 0 needs its
    unit: a number without one could mean millimetres or metres."""

    def parse(text: str) -> float:
        from tacsim.models.quantity import parse_quantity as parse_quantity

        try:
            value = parse_quantity(text, kind, bare=kind != "length")
        except ValueError as error:
            raise typer.BadParameter(str(error)) from None
        if not low <= value <= high:
            raise typer.BadParameter(f"{value:g}; allowed: {low:g} to {high:g} (SI units)")
        return value

    return parse


def quantities_parser(kind: str, count: int) -> Callable[[str], tuple[float, ...]]:
    """Parser of an option that is `count` lengths, angles ..., separated by commas."""

    def parse(text: str) -> tuple[float, ...]:
        parts = text.split(",")
        if len(parts) != count:
            raise typer.BadParameter(f"'{text}' has {len(parts)} values, {count} are needed, separated by commas")
        return tuple(quantity_parser(kind)(part.strip()) for part in parts)

    return parse


def length_option(help_: str, low: float = -math.inf, high: float = math.inf) -> Any:
    """An option that is a length, `low` to `high` [m]."""
    return typer.Option(parser=quantity_parser("length", low, high), metavar="LENGTH", help=help_)


def with_json_option(command: Callable[..., None]) -> Callable[..., None]:
    """Makes a command with the option --json, by which `print_json` prints the result."""
    return _JsonCommand(command)


class _JsonCommand:
    """Reads the signature only when it is needed."""

    def __init__(self, command: Callable[..., None]) -> None:
        update_wrapper(self, command)
        self._command = command

    def __call__(self, *, as_json: bool, **given: Any) -> None:  # the option's callback has used it
        self._command(**given)

    @property
    def __signature__(self) -> inspect.Signature:
        own = inspect.signature(self._command, eval_str=True).parameters.values()
        keyword = inspect.Parameter.KEYWORD_ONLY
        added = inspect.Parameter("as_json", keyword, default=False, annotation=AsJson)
        return inspect.Signature([*(each.replace(kind=keyword) for each in own), added])


class OptionGroup:
    """Options of one or several commands, as annotated attributes with defaults; see `with_option_groups`."""

    def __init__(self, **values: Any) -> None:
        self.__dict__.update(values)


def with_option_groups(command: Callable[..., None]) -> Callable[..., None]:
    """Makes a command whose OptionGroup parameters are replaced by their attributes, as options of the command."""
    return _GroupedCommand(command)


class _GroupedCommand:
    """Reads the signature only when it is needed: reading those of all commands would take 10 ms."""

    def __init__(self, command: Callable[..., None]) -> None:
        self._command = command
        update_wrapper(self, command)

    def __call__(self, **given: Any) -> None:
        groups = {
            name: kind(**{option: given.pop(option) for option in kind.__annotations__})
            for name, kind in self._groups.items()
        }
        self._command(**given, **groups)

    @cached_property
    def _parameters(self) -> Mapping[str, inspect.Parameter]:
        return inspect.signature(self._command, eval_str=True).parameters

    @cached_property
    def _groups(self) -> dict[str, type[OptionGroup]]:
        kinds = {name: parameter.annotation for name, parameter in self._parameters.items()}
        return {name: kind for name, kind in kinds.items() if isinstance(kind, type) and issubclass(kind, OptionGroup)}

    @property
    def __signature__(self) -> inspect.Signature:
        found: list[inspect.Parameter] = []
        for name, parameter in self._parameters.items():
            if name not in self._groups:
                found.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
                continue
            kind = self._groups[name]
            found += [
                inspect.Parameter(
                    option, inspect.Parameter.KEYWORD_ONLY, default=getattr(kind, option), annotation=annotation
                )
                for option, annotation in get_type_hints(kind, include_extras=True).items()
            ]
        return inspect.Signature(found)


def angle_option(help_: str, low: float = -math.inf, high: float = math.inf) -> Any:
    """An option that is an angle, `low` to `high` [rad]."""
    return typer.Option(parser=quantity_parser("angle", low, high), metavar="ANGLE", help=help_)


def require_packages(command: str, extra: str, *modules: str) -> None:
    """Raises CannotOpen, with the extra to install, unless all modules are installed."""
    from importlib.util import find_spec

    from robot.open import CannotOpen

    if missing := [name for name in modules if find_spec(name) is None]:
        *others, last = missing
        named = f"{', '.join(others)} and {last}, which are" if others else f"{last}, which is"
        raise CannotOpen(f"{command} needs {named} not installed: pip install 'tacsim[{extra}]'")

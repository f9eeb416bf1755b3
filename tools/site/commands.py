"""The page of the commands, from the help of the commands themselves."""

from __future__ import annotations

import re
from typing import Any

import typer
from rich.text import Text

INTRODUCTION = """# Commands

Generated from the help of the commands. `tacsim COMMAND --help` prints the same on a terminal.

`--debug`, anywhere on the line, shows tracebacks. Every command ends with exit code 0, with 1 and an error message, or
with 2 if the line itself is wrong."""


def plain(text: str | None) -> str:
    """Help without the markup of the terminal, in one line."""
    return " ".join(Text.from_markup(text or "").plain.split())


def cell(text: str) -> str:
    """Text for a cell of a table, with words in brackets kept as text."""
    return text.replace("|", "\\|").replace("<", "&lt;").replace("[", "\\[")


def default_of(parameter: Any) -> str:
    """The default as it is typed, or its description; empty where there is none."""
    if isinstance(parameter.show_default, str):
        return cell(parameter.show_default)
    value = parameter.default
    if value is None or callable(value) or isinstance(value, bool) or value in ((), [], ""):
        return ""
    return f"`{getattr(value, 'value', value)}`"


def names_of(parameter: Any) -> str:
    """An option with its value, or an argument, as it is typed."""
    if parameter.param_type_name == "argument":
        return f"`{(parameter.metavar or parameter.name).upper().strip('[]')}`"
    names = [*parameter.opts, *parameter.secondary_opts]
    value = "" if parameter.is_flag or parameter.count else f" {parameter.metavar or parameter.name.upper()}"
    return ", ".join(f"`{name}{value}`" for name in names)


def rows_of(command: Any) -> list[str]:
    """One row of the table for each argument and option that the help shows."""
    shown = [each for each in command.params if not each.hidden and "--help" not in each.opts]
    rows = []
    for each in shown:
        words = cell(plain(each.help)) + (" **Required.**" if each.required else "")
        rows.append(f"| {names_of(each)} | {words} | {default_of(each)} |")
    return rows


def section(name: str, command: Any, level: int) -> list[str]:
    """Headings, text and tables of one command, and of the commands in it."""
    paragraphs = [plain(each) for each in re.split(r"\n\s*\n", command.help or "")]
    parts = [f"{'#' * level} `{name}`", *(cell(each) for each in paragraphs)]
    children = getattr(command, "commands", {})
    if rows := rows_of(command):
        parts.append("\n".join(["| Argument or option | Meaning | Default |", "|---|---|---|", *rows]))
    if example := plain(command.epilog):
        example, _, remark = example.removeprefix("Example:").strip().partition(" · ")
        parts.append(f"```text\n{example.strip()}\n```")
        parts += [cell(remark)] if remark else []
    for child, each in children.items():
        if not each.hidden:
            parts += section(f"{name} {child}", each, level + 1)
    return parts


def markdown(app: typer.Typer) -> str:
    """The page of all commands of `app`."""
    commands = typer.main.get_command(app)
    parts = [INTRODUCTION]
    for name, command in getattr(commands, "commands", {}).items():
        parts += section(f"tacsim {name}", command, 2)
    return "\n\n".join(parts) + "\n"

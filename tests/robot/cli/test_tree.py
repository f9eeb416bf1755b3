"""The commands, arguments and options of 0.1.0 are all there still, with the same names, defaults and kinds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import typer

from robot.cli import app

ATTRIBUTES = ("required", "multiple", "nargs", "metavar", "min", "max")
FIXTURE = Path(__file__).resolve().parents[2] / "fixtures" / "cli_0_1_0.json"


def tree(command: Any) -> dict[str, Any]:
    """Commands and parameters below `command`, as JSON can hold them."""
    options = {
        (parameter.opts or [parameter.name])[0]: {
            "opts": [*parameter.opts, *parameter.secondary_opts],
            "default": str(parameter.default),
            **{key: getattr(parameter, key, None) for key in ATTRIBUTES},
        }
        for parameter in command.params
    }
    commands = {name: tree(each) for name, each in sorted(getattr(command, "commands", {}).items())}
    return {"parameters": options, "commands": commands}


# The default depends on what is compared now: none of a scene, whose pictures are made in B's pixels
CHANGED = {("tacsim compare", "--shift")}
# Defaults are None, so that a size of another indenter can be refused; the result is as before
CHANGED |= {("tacsim press", option) for option in ("--radius", "--height", "--size", "--scale")}
# The file `-` prints the document on stdout, as --json of the other commands
CHANGED |= {("tacsim bench", "--json"), ("tacsim evaluate", "--json")}


@pytest.mark.deep
def test_commands_and_options_of_first_release_exist() -> None:
    """Made again by running this file with the code to compare with on PYTHONPATH."""
    before = json.loads(FIXTURE.read_text(encoding="utf-8"))
    now = json.loads(json.dumps(tree(typer.main.get_command(app))))
    missing: list[str] = []

    def compare(old: dict[str, Any], new: dict[str, Any], name: str) -> None:
        missing.extend(
            f"{name}: {key}: {before_value} -> {new['parameters'].get(key)}"
            for key, before_value in old["parameters"].items()
            if new["parameters"].get(key) != before_value and (name, key) not in CHANGED
        )
        for key, each in old["commands"].items():
            if key in new["commands"]:
                compare(each, new["commands"][key], f"{name} {key}")
            else:
                missing.append(f"{name} {key}: the command is gone")

    compare(before, now, "tacsim")
    assert missing == []


if __name__ == "__main__":
    FIXTURE.parent.mkdir(exist_ok=True)
    FIXTURE.write_text(json.dumps(tree(typer.main.get_command(app)), sort_keys=True) + "\n", encoding="utf-8")

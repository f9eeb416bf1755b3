"""The pages of the Python interface: one line for mkdocstrings for each public name, by subject."""

from __future__ import annotations

import ast
import importlib
import inspect

SUBJECTS = {  # page: title, introduction, package, modules that the names come from
    "contract": ("Observations, actions, rigs", "tacsim", ("interface", "rig", "limits", "pose", "control")),
    "configuration": ("Configuration", "tacsim", ("config", "models")),
    "simulation": ("Simulation", "tacsim", ("physics", "optics", "sim")),
    "episodes": ("Episodes and reports", "tacsim", ("record", "report")),
    "tasks": ("Tasks", "tacsim", ("tasks",)),
    "environments": ("Environments", "tacsim", ("gym",)),
    "robot": ("Robots", "robot", ("",)),
    "mock": ("Mock devices", "robot.mock", ("",)),
    "calibration": ("Calibration", "calibration", ("",)),
}


def paths_of_names(package: str) -> dict[str, str]:
    """The full path of each name that `package/__init__.py` imports."""
    tree = ast.parse(inspect.getsource(importlib.import_module(package)))
    return {
        alias.asname or alias.name: f"{node.module}.{alias.name}"
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module is not None
        for alias in node.names
    }


def public_names(subject: str) -> dict[str, str]:
    """The full path of each public name of a subject."""
    _, package, rooms = SUBJECTS[subject]
    paths = paths_of_names(package)
    names = sorted(importlib.import_module(package).__all__, key=str.lower)
    return {
        name: paths[name]
        for name in names
        if "" in rooms or paths[name].removeprefix(f"{package}.").partition(".")[0] in rooms
    }


def markdown(subject: str) -> str:
    """The page of a subject, for mkdocstrings."""
    title, package, _ = SUBJECTS[subject]
    names = public_names(subject)
    parts = [f"# {title}", f"Import these names from `{package}`: `from {package} import {next(iter(names))}`."]
    parts += [f"::: {path}" for path in names.values()]
    return "\n\n".join(parts) + "\n"

"""Python code of the user, named as "package.module:attribute"."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

from tacsim.models.text import suggest_word

PACKAGES = ("tacsim", "calibration", "robot")


class CodeNotFound(ValueError):
    """A name refers to no code."""


def load_attribute(name: str) -> object:
    """Imports "package.module:attribute", which runs code of that module. Raises CodeNotFound."""
    module_name, _, path = name.partition(":")
    if not path or not all(part.isidentifier() for part in [*module_name.split("."), *path.split(".")]):
        raise CodeNotFound(f"'{name}' must have the form 'package.module:attribute'")
    try:
        found: object = importlib.import_module(module_name)
    except ModuleNotFoundError as failure:
        missing = failure.name or ""
        if not missing or not (module_name + ".").startswith(missing + "."):
            why = f"module '{module_name}' itself imports '{missing}', which is missing"
        else:
            why = f"no module '{missing}'; is its folder on PYTHONPATH?"
        raise CodeNotFound(f"'{name}': {why}{_describe_shadowing_file(missing)}") from failure
    except (Exception, SystemExit) as failure:  # a script may end Python when it is imported
        why = f"importing '{module_name}' failed: {failure!r}{_describe_shadowing_file(str(failure))}"
        raise CodeNotFound(f"'{name}': {why}") from failure
    for part in path.split("."):
        if not hasattr(found, part):
            hint = suggest_word(part, [key for key in dir(found) if not key.startswith("_")])
            raise CodeNotFound(
                f"'{name}': '{module_name}' has no '{path}'{hint}{_describe_shadowing_file(module_name)}"
            )
        found = getattr(found, part)
    return found


def _describe_shadowing_file(message: str) -> str:
    """Text for an error `message` that names a package of tacsim, if a file in the working folder has the same name."""
    root = Path(__file__).resolve().parents[2]
    for package in PACKAGES:
        for path in (Path(package).absolute(), Path(f"{package}.py").absolute()):
            if re.search(rf"\b{package}\b", message) and path.exists() and path.resolve() != root / package:
                return f". '{package}' is a package of tacsim, {path} is not imported: rename it"
    return ""

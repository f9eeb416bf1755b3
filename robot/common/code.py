"""A person's own Python code, named as "package.module:attribute"."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

PACKAGES = ("tacsim", "calibration", "robot")


class CodeNotFound(ValueError):
    """A name leads to no code."""


def attribute(name: str) -> object:
    """What "package.module:attribute" names. Runs code of that module. Raises CodeNotFound."""
    module_name, _, path = name.partition(":")
    if not path or not all(part.isidentifier() for part in [*module_name.split("."), *path.split(".")]):
        raise CodeNotFound(f"'{name}' must have the form 'package.module:attribute'")
    try:
        found: object = importlib.import_module(module_name)
    except ModuleNotFoundError as failure:
        missing = failure.name or ""
        if not missing or not (module_name + ".").startswith(missing + "."):
            why = f"module '{module_name}' itself imports '{missing}', which is missing{_namesake(missing)}"
        else:
            why = f"no module '{missing}'; is its folder on PYTHONPATH?{_namesake(missing)}"
        raise CodeNotFound(f"'{name}': {why}") from failure
    except (Exception, SystemExit) as failure:  # a script may end Python when it is imported
        why = f"importing '{module_name}' failed: {failure!r}{_namesake(str(failure))}"
        raise CodeNotFound(f"'{name}': {why}") from failure
    for part in path.split("."):
        if not hasattr(found, part):
            raise CodeNotFound(f"'{name}': '{module_name}' has no '{path}'{_namesake(module_name)}")
        found = getattr(found, part)
    return found


def _namesake(words: str) -> str:
    """What to add to an error that speaks of one of our packages: a file in the working folder has the same name."""
    ours = Path(__file__).resolve().parents[2]
    for package in PACKAGES:
        for path in (Path(package).absolute(), Path(f"{package}.py").absolute()):
            if re.search(rf"\b{package}\b", words) and path.exists() and path.resolve() != ours / package:
                return f". '{package}' is a package of tacsim, {path} is not imported: rename it"
    return ""

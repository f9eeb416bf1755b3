"""What is shipped and installed, by kind and name: configuration files, learned policies, drivers."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from tacsim.config.kinds import KINDS, NotFound, config_root
from tacsim.models.driver import BASE_CLASSES, installed_drivers
from tacsim.models.text import suggest_word

POLICY, DRIVER = "policy", "driver"
CATALOGUE_KINDS = (*KINDS, POLICY, DRIVER)


@dataclass(frozen=True, slots=True)
class CatalogueEntry:
    """Something with a name that a command or a file may use."""

    kind: str  # of CATALOGUE_KINDS
    name: str  # as it is written in files and commands; of drivers "sensor.NAME" or "arm.NAME"
    summary: str  # one sentence
    path: Path | None  # its file; of a driver the module; None if it is not known


def list_entries(kind: str) -> list[CatalogueEntry]:
    """What there is of a kind of CATALOGUE_KINDS, sorted by name. Raises KeyError for another kind."""
    if kind == DRIVER:
        return list(_installed_drivers())
    if kind == POLICY:
        paths = sorted((config_root() / "policies").glob("*.onnx"))
        return [CatalogueEntry(kind, path.stem, f"Learned policy of the task {path.stem}.", path) for path in paths]
    paths = sorted((config_root() / KINDS[kind].folder).glob("*.yaml"))
    return [CatalogueEntry(kind, path.stem, _first_sentence(path.read_text("utf-8")), path) for path in paths]


def find_entries(name: str, kind: str | None = None) -> list[CatalogueEntry]:
    """Every entry of that name, of one kind or (None) of all. Raises NotFound, with the nearest name."""
    kinds = CATALOGUE_KINDS if kind is None else (kind,)
    known = [entry for each in kinds for entry in list_entries(each)]
    found = [entry for entry in known if entry.name == name]
    if not found:
        names = [entry.name for entry in known]
        what = "nothing is" if kind is None else f"no {kind} is"
        where = "tacsim list" if kind is None else f"tacsim list {kind}"
        raise NotFound(f"{what} called '{name}'{suggest_word(name, names)}; `{where}` prints all names")
    return found


def _installed_drivers() -> Iterable[CatalogueEntry]:
    drivers = installed_drivers()
    for kind in sorted(BASE_CLASSES):
        for name, driver in sorted(drivers.usable[kind].items()):
            summary = inspect.cleandoc(driver.__doc__ or "").partition("\n\n")[0].replace("\n", " ")
            yield CatalogueEntry(DRIVER, f"{kind}.{name}", summary, Path(inspect.getfile(driver)))
        for name, why in sorted(drivers.refused[kind].items()):
            yield CatalogueEntry(DRIVER, f"{kind}.{name}", f"Refused: {why}", None)


def _first_sentence(text: str) -> str:
    """The first sentence of the comment that a file begins with; empty without one."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        lines.append(line.lstrip("# ").rstrip())
    return re.split(r"(?<=[.!?]) ", " ".join(lines), maxsplit=1)[0]

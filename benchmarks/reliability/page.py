"""docs/reliability.md, from a report with rows of the group robot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from benchmarks.harness.schema import Report, Row
from benchmarks.pages.page import setting, table
from benchmarks.pages.targets import Target, pick
from benchmarks.reliability.promises import PROMISES

PAGE = "reliability.md"
HEADER = ("promise", "figure", "measured", "worst", "promised", "verdict")
SAFETY = (
    "**None of this is a safety function.** What guards here is software on an ordinary computer; it protects the work "
    "and the sensors, not people. Safety planes, speed and force limits belong into the safety configuration on the "
    "pendant, and a risk assessment before anything moves. All figures are of mock controllers and mock cameras on "
    "loopback: the drivers and the wire are the true ones, brakes, cables and the controller's own delays are not. No "
    "real arm was measured."
)
READING = (
    "- **Measured** is the median of {repeat}, *worst* the worst of them; what must not happen at all is "
    "summed over all. The verdict is on the median; *met, worst beyond* says that a repetition was not within it.\n"
    "- **An idle machine** is meant. Others that work on it are told above by the load; with a load near the number of "
    "cores or beyond it the times here say more about them than about us. The logic itself is tested in `make test`, "
    "counted in control periods, packages and registers, with configured time-outs and bounds ten times wider.\n"
    "- **Rerun:** `tacsim bench robot --long --json benchmarks/reliability.json`, then `tacsim bench --from "
    "benchmarks/reliability.json --docs docs`. `tacsim bench all` leaves this group out. ur_rtde has no wheel for "
    "Python 3.13; there only the guard and the camera are measured."
)


def write_reliability(report: Report, folder: Path) -> Path:
    """Writes reliability.md into `folder`; returns its path. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    page = folder / PAGE
    page.write_text(markdown(report), encoding="utf-8")
    return page


def markdown(report: Report) -> str:
    """The page. The same report gives the same text."""
    rows, count = [row for row in report.results if row.group == "robot"], report.metadata.repeat
    parts = [
        "# Reliability",
        "Fifteen promises of arms and cameras, as figures. Written by `tacsim bench --from FILE --docs docs`; do not "
        "edit.",
        SAFETY,
        setting(report) + _busy(report),
        "## Figures",
        table(HEADER, lines(rows)),
        *_notes(rows),
        "## How to read and rerun",
        READING.format(repeat=f"{count} repetition{'s' * (count > 1)}"),
        "## What a promise says, and which tests check its logic",
        "\n".join(_logic(number) for number in range(len(PROMISES))),
    ]
    failures = [failure for failure in report.failures if failure.group == "robot"]
    if failures:
        parts += ["## Failed", *(f"- {each.case}: {each.cause}" for each in failures)]
    return "\n\n".join(parts) + "\n"


def lines(rows: Sequence[Row]) -> list[list[str]]:
    """The table as text, a list of cells a figure."""
    found = []
    for number, promise in enumerate(PROMISES, start=1):
        for figure in promise.figures:
            value, verdict = figure.judge(rows)
            worst = _worst(figure, rows)
            if figure.must is None:
                words = "to compare with"
            elif verdict == "met" and worst is not None and worst > figure.must:
                words = "met, worst beyond"
            else:
                words = f"**{verdict}**" if verdict == "missed" else verdict
            promised = _words(figure.must, figure.unit)
            name = f"{number} {promise.name}"
            found.append([name, figure.name, _words(value, figure.unit), _words(worst, figure.unit), promised, words])
        if not promise.figures:
            found.append([f"{number} {promise.name}", "its logic alone: see below", "", "", "", ""])
    return found


def _worst(figure: Target, rows: Sequence[Row]) -> float | None:
    """Of the repetitions; None for what is counted over all of them."""
    found = [row for row in rows if figure.value([row]) is not None]
    names = [name for row in found for name in row.figures if name.startswith("worst_")]
    return pick(names[0], found[0].case, found[0].variant)(found) if names else None


def _words(value: float | None, unit: str) -> str:
    return "" if value is None else f"{value:.3g} {unit}".strip()


def _notes(rows: Sequence[Row]) -> list[str]:
    """What was disturbed while it was measured, once for each case."""
    noted = {row.case: row.note for row in rows if row.note}
    return ["\n".join(f"- `{case}`: {note}." for case, note in noted.items())] if noted else []


def _logic(index: int) -> str:
    promise = PROMISES[index]
    tests: dict[str, list[str]] = {}
    for test in promise.tests:
        file, _, function = test.partition("::")
        tests.setdefault(file, []).append(f"`{function.removeprefix('test_')}`")
    listed = "; ".join(f"`tests/{file}`: {', '.join(functions)}" for file, functions in tests.items())
    return f"{index + 1}. **{promise.name}.** {promise.text} {listed}."


def _busy(report: Report) -> str:
    machine = report.metadata.machine
    priority = ""
    if machine.realtime is not None:
        granted = "allowed" if machine.realtime else "not allowed"
        priority = f" Real-time priority, which workers and mock controllers ask for, was {granted}."
    loads = [each[0] for each in (machine.load_before, machine.load_after) if each is not None]
    if loads and max(loads) > 0.5 * machine.cores:
        return priority + " **The machine was not idle**: take the times as upper bounds."
    return priority + (" The machine was idle otherwise." if loads else "")

"""docs/reliability.md, from a report with rows of the group robot: the figures that tests record for each promise.

A test marked `promise(n)` checks promise n; tests with the fixture `figure` (tests/promises.py) also record delays,
distances and counts. A row of the report is one figure: its case is the promise's name, its variant the figure's.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.harness.schema import Report, Row
from benchmarks.pages.page import setting, table

PAGE = "reliability.md"
ROOT = Path(__file__).resolve().parents[2]
HEADER = ("promise", "figure", "measured", "worst", "promised", "verdict")
EVENT = " · "  # between event and column, in the name of a figure in the table of events
EVENTS = ("event", "still after", "path", "reported after", "moved after standstill", "programs left running")
WATCHED = (
    "An arm at 0.1 m/s, measured by an RTDE client in a separate process: median / worst of {repeat}. The driver runs "
    "in a user's program behind a proxy that breaks its connections; the proxy restores them after 0.1, 1 or 3 s, or "
    "at once (held ones: never) in turn. *Still after* is the time to the first standstill (below 1 mm/s) after the "
    "event, *path* the distance until then. The arm is measured for another five seconds: *moved after standstill* is "
    "its largest distance from that position. *Goes on* is an event that does not affect the motion. A hung policy "
    "gets no report, because it reads no status."
)
COUNT = "count"  # unit of events that must never happen
PROMISES: tuple[tuple[str, str], ...] = (  # promise n is the n-th
    ("Box", "No target leaves the workspace, for any command; an arm without limits does not connect."),
    (
        "Speed",
        "Speed, acceleration and joint steps of the sent targets stay within their limits; so do speed and "
        "acceleration of the measured arm when its controller slows it down, stalls or stops. An invalid pose makes it "
        "hold.",
    ),
    ("Force", "A force above the limit stops the arm in the period of its package."),
    (
        "Stale",
        "A silent connection is reported, and the driver survives it; a frame beyond its maximum age is refused.",
    ),
    (
        "Late policy",
        "Without a new action the arm holds, reports it, and continues from its measured pose. After the last action "
        "it moves at most speed x (action_timeout + the servo's lag of about 0.04 s).",
    ),
    ("Death", "If a policy or a worker is killed, the arm stops; soon afterwards another worker can start."),
    (
        "Stops",
        "A stop is reported with its kind and its first cause, and so is an arm that does not follow or that another "
        "program moves; after any failure, an arm at rest does not move before recover(), no program continues, and no "
        "old command is repeated.",
    ),
    ("One commander", "A second driver is refused, the first continues."),
    ("Connecting", "Connecting without a server ends with a time-out and blocks no other thread."),
    ("One instant", "All fields of a state are of one package; a pose is that of the picture's exposure."),
    (
        "Camera",
        "A read returns the newest frame, never an old one as new; a lost camera is opened again; a source that "
        "differs from the configuration is refused.",
    ),
    ("One contract", "A policy sees the same keys, types, shapes, units and frames on every kind of rig."),
    ("Rate", "500 periods a second, also with two arms."),
    (
        "Shutdown",
        "Closing ends quickly, may be repeated, and leaves no process or file; an episode is readable after a kill.",
    ),
    ("Two arms", "They keep their distance if either moves, and both stop when one does."),
    (
        "Live page",
        "STOP of `tacsim serve` brakes every arm, whatever runs; it needs no permission, and none is lost. Nothing "
        "moves before the next start. Motion stops when the page is lost, and no page of another site starts one.",
    ),
)
SAFETY = (
    "**None of this is a safety function.** These checks are software on an ordinary computer; they protect the work "
    "and the sensors, not people. Safety planes, speed and force limits belong into the safety configuration on the "
    "pendant, and a risk assessment must precede any motion. All figures are from mock controllers and mock cameras on "
    "loopback: drivers and protocols are the real ones; brakes, cables and delays of the controller are not. No real "
    "arm was measured."
)
READING = (
    "- **Measured** is the median of {repeat}, *worst* the worst of them; events that must never happen are summed "
    "over all. The verdict is on the median; *met, worst beyond* means that a repetition exceeded the promise.\n"
    "- **An idle machine** is assumed. The load above shows other programs; with a load near or above the number of "
    "cores, the times depend mostly on them. `make test` runs the same tests once, with longer time-outs, and judges "
    "by positions and the controller's clock, not by durations.\n"
    "- **Rerun:** `make reliability`, or `tacsim bench robot --long --json benchmarks/reliability.json --docs docs`: "
    "the tests below that record a figure, five times each. `tacsim bench all` leaves this group out. ur_rtde has no "
    "wheel for Python 3.13, so there only the limits and the camera are measured."
)


@dataclass(frozen=True, slots=True)
class Figure:
    """Result of one repetition of a test."""

    promise: int  # its number
    name: str
    value: float
    unit: str
    at_most: float | None  # the promised limit; None: for comparison only
    test: str  # test that recorded it
    seconds: float  # duration of the test
    cpu_seconds: float


def rows(figures: Iterable[Figure], peak_mb: float) -> list[Row]:
    """A row for each figure over its repetitions: the median of a measurement, the sum of a count."""
    together: dict[tuple[int, str], list[Figure]] = {}
    for figure in figures:
        together.setdefault((figure.promise, figure.name), []).append(figure)
    return [_row(found, peak_mb) for _, found in sorted(together.items(), key=lambda item: item[0][0])]


def _row(found: Sequence[Figure], peak_mb: float) -> Row:
    first, values = found[0], [each.value for each in found]
    suffix = {"%": "percent", "µs": "us"}.get(first.unit, first.unit)
    numbers = {} if first.at_most is None else {f"promised_{suffix}": first.at_most}
    if first.unit != COUNT:
        numbers[f"worst_{suffix}"] = max(values)
    if first.unit != COUNT and len(values) > 2:
        low, high = np.percentile(values, [25, 75])
        numbers[f"spread_{suffix}"] = float(high - low)
    return Row(
        group="robot",
        case=PROMISES[first.promise - 1][0],
        variant=first.name,
        method="tacsim",
        resolution="mock",
        seconds=float(np.median([each.seconds for each in found])),
        spread=None,
        cpu_seconds=float(np.median([each.cpu_seconds for each in found])),
        repeats=len(found),
        error=float(sum(values) if first.unit == COUNT else np.median(values)),
        error_unit=first.unit,
        against=first.test,
        peak_mb=peak_mb,
        figures=numbers,
    )


def write_reliability(report: Report, folder: Path) -> Path:
    """Writes reliability.md into `folder`; returns its path. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    page = folder / PAGE
    page.write_text(markdown(report), encoding="utf-8")
    return page


def markdown(report: Report) -> str:
    """The page. The same report and the same tests give the same text."""
    measured, count, tests = _of_robot(report), report.metadata.repeat, marked_tests()
    failures = [failure for failure in report.failures if failure.group == "robot"]
    parts = [
        "# Reliability",
        f"{len(PROMISES)} promises of arms, cameras and the live page, as figures that their own tests record. Written "
        "by `make reliability`, or `tacsim bench --from FILE --docs docs`; do not edit.",
        SAFETY,
        setting(report) + _load_note(report),
        "## Figures",
        table(HEADER, lines([row for row in measured if EVENT not in row.variant])),
        *_separate_runs(measured),
        *_events(measured),
        "## How to read and rerun",
        READING.format(repeat=_format_repetitions(count)),
        "## What a promise says, and which tests check it",
        "\n".join(_describe_promise(number, tests.get(number, [])) for number in range(1, len(PROMISES) + 1)),
    ]
    if failures:
        parts += ["## Failed", *(f"- {each.case}: {each.cause}" for each in failures)]
    return "\n\n".join(parts) + "\n"


def lines(measured: Sequence[Row]) -> list[list[str]]:
    """The table as text, a list of cells for each figure."""
    found = []
    for number, (promise, _) in enumerate(PROMISES, start=1):
        mine = [row for row in measured if row.case == promise]
        found += [[f"{number} {promise}", *_cells(row)] for row in mine]
        if not mine:
            found.append([f"{number} {promise}", "no figure: see its tests below", "", "", "", ""])
    return found


def replace_promise(report: Report, new: Report, number: int) -> Report:
    """`report` with the rows and failures of one promise taken from `new`, a later run of that promise alone. Each of
    its rows notes when, of which commit and under which load it was measured."""
    made, name = new.metadata, PROMISES[number - 1][0]
    loads = [f"{load[0]:.1f}" for load in (made.machine.load_before, made.machine.load_after) if load is not None]
    load = f"; load average {' to '.join(loads)}" if loads else ""
    commit = f"{made.commit}{' with changes' if made.modified else ''}"
    note = f"{made.date:%Y-%m-%d}, commit {commit}, {made.machine.cpu}{load}"
    rows = [row for row in report.results if row.case != name]
    rows += [row.model_copy(update={"note": note}) for row in new.results if row.case == name]
    tests = set(marked_tests()[number])
    kept = [failure for failure in report.failures if failure.case.partition("[")[0] not in tests]
    return report.model_copy(update={"results": rows, "failures": [*kept, *new.failures]})


def _separate_runs(measured: Sequence[Row]) -> list[str]:
    """A paragraph on promises that were measured in a run of their own; empty without any."""
    notes = dict.fromkeys((row.case, row.note) for row in measured if row.note)
    return [f"Measured in a run of its own: {'; '.join(f'*{case}*, {note}' for case, note in notes)}."] if notes else []


def _events(measured: Sequence[Row]) -> list[str]:
    """The table of events with its heading, or an empty list without events."""
    found: dict[str, dict[str, Row]] = {}
    for row in measured:
        event, separator, column = row.variant.partition(EVENT)
        if separator:
            found.setdefault(event, {})[column] = row
    if not found:
        return []
    cells = [
        [event, *(_median_and_worst(columns.get(name)) for name in EVENTS[1:])] for event, columns in found.items()
    ]
    for line, columns in zip(cells, found.values(), strict=True):
        if "goes on" in columns:
            line[1] = "goes on" + ("" if "still after" not in columns else f"; else {line[1]}")
    repeat = max(row.repeats for columns in found.values() for row in columns.values())
    return ["## A stopped arm stays stopped", WATCHED.format(repeat=_format_repetitions(repeat)), table(EVENTS, cells)]


def _median_and_worst(row: Row | None) -> str:
    """Median and worst value, or a count."""
    if row is None:
        return ""
    if row.error_unit == COUNT:
        return f"{row.error:.0f}"
    worst = next(value for name, value in row.figures.items() if name.startswith("worst"))
    digits = 3 if row.error_unit == "mm" and worst < 0.1 else 1 if row.error_unit == "mm" else 0
    return f"{row.error:.{digits}f} / {worst:.{digits}f} {row.error_unit}"


def _format_repetitions(count: int) -> str:
    return f"{count} repetition{'s' * (count > 1)}"


def _cells(row: Row) -> list[str]:
    unit = "" if row.error_unit == COUNT else row.error_unit
    worst, promised = (
        next((value for name, value in row.figures.items() if name.startswith(kind)), None)
        for kind in ("worst", "promised")
    )
    if promised is None:
        verdict = "to compare with"
    elif row.error > promised:
        verdict = "**missed**"
    else:
        verdict = "met" if worst is None or worst <= promised else "met, worst beyond"
    return [
        row.variant,
        _format_value(row.error, unit),
        _format_value(worst, unit),
        _format_value(promised, unit),
        verdict,
    ]


def _format_value(value: float | None, unit: str) -> str:
    return "" if value is None else f"{value:.3g} {unit}".strip()


def _of_robot(report: Report) -> list[Row]:
    return [row for row in report.results if row.group == "robot"]


@cache
def marked_tests() -> dict[int, list[str]]:
    """The tests marked with the number of each promise, as `tests/path.py::name`, read from the checkout."""
    found: dict[int, list[str]] = {}
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        text = path.read_text(encoding="utf-8")
        functions = [node for node in ast.parse(text).body if isinstance(node, ast.FunctionDef)]
        for node in functions if "mark.promise" in text else ():
            for mark in node.decorator_list:
                if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.promise":
                    for number in map(ast.literal_eval, mark.args):
                        found.setdefault(number, []).append(f"{path.relative_to(ROOT).as_posix()}::{node.name}")
    return found


def _describe_promise(number: int, tests: Iterable[str]) -> str:
    files: dict[str, list[str]] = {}
    for test in tests:
        file, _, function = test.partition("::")
        files.setdefault(file, []).append(f"`{function.removeprefix('test_')}`")
    listed = "; ".join(f"`{file}`: {', '.join(functions)}" for file, functions in files.items())
    name, text = PROMISES[number - 1]
    return f"{number}. **{name}.** {text} {listed}."


def _load_note(report: Report) -> str:
    machine = report.metadata.machine
    priority = ""
    if machine.realtime is not None:
        granted = "allowed" if machine.realtime else "not allowed"
        priority = f" Real-time priority, which workers and mock controllers ask for, was {granted}."
    loads = [each[0] for each in (machine.load_before, machine.load_after) if each is not None]
    if loads and max(loads) > 0.5 * machine.cores:
        return priority + " **The machine was not idle**: take the times as upper bounds."
    return priority + (" The machine was idle otherwise." if loads else "")

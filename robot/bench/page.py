"""docs/benchmarks.md and speed_vs_error.png, from a report."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from robot.bench.cases import description
from robot.bench.schema import Report, Row

GROUP_WORDS = {
    "press": "Press: a rigid indenter on one gel",
    "squeeze": "Squeeze: plasticine between two gels",
    "materials": "Materials: laws, elements, transfers, and what a substep costs",
}
COLUMNS = ("case", "method", "resolution", "seconds", "CPU s", "error", "MB", "substeps")
# what is drawn: case, variant ("" for any), title, unit of the error
PANELS = (
    ("sphere_press", "", "Ball R 4 mm, 1 mm deep", "error of the surface [µm rms]"),
    ("squeeze", "settled to 1 %", "3 mm squeeze, settled", "error of the force [%]"),
    ("plasticine_step", "", "Yield of a 10 mm cube", "error of the stress [%]"),
)
PICTURE = "speed_vs_error.png"


def cells(row: Row) -> list[str]:
    """A row of the table, as text."""
    name = row.case if not row.variant else f"{row.case}: {row.variant}"
    spread = "" if row.spread is None else f" ± {row.spread:.2g}"
    substeps = "" if row.substeps is None else str(row.substeps)
    error = f"{row.error:.3g} {row.error_unit}"
    return [
        name, row.method, row.resolution, f"{row.seconds:.3g}{spread}", f"{row.cpu_seconds:.3g}", error,
        f"{row.peak_mb:.0f}", substeps,
    ]  # fmt: skip


def costs(row: Row) -> list[str]:
    """The costs of a substep for each particle or element, as text."""
    found = []
    for name, value in row.figures.items():
        kind, per, rest = name.partition("_per_")
        if per and rest.endswith("_substep_ns"):
            found.append(f"{value:.0f} ns {kind} a substep and {rest.removesuffix('_substep_ns')}")
    return found


def write_page(report: Report, folder: Path) -> list[Path]:
    """Writes benchmarks.md and images/speed_vs_error.png below `folder`; returns both paths. Raises OSError."""
    picture = folder / "images" / PICTURE
    picture.parent.mkdir(parents=True, exist_ok=True)
    draw(report.results, picture)
    page = folder / "benchmarks.md"
    page.write_text(markdown(report), encoding="utf-8")
    return [page, picture]


def markdown(report: Report) -> str:
    """The page. The same report gives the same text."""
    parts = [
        "# Benchmarks",
        "Written by `tacsim bench --from FILE --docs docs`; do not edit. Every row is time, error and memory of one "
        "run, each case in a process of its own, kernels compiled before the clock starts. Seconds are the median of "
        "wall time ± interquartile range (none with fewer than three repetitions), CPU s the processor time of all "
        "threads.",
        _setting(report),
        f"![Time against error, by method](images/{PICTURE})",
    ]
    for group, words in GROUP_WORDS.items():
        rows = [row for row in report.results if row.group == group]
        if rows:
            parts += [f"## {words}", _table(COLUMNS, map(cells, rows)), *_remarks(rows)]
    if report.failures:
        parts += ["## Failed", *(f"- {f.case}, {f.method}, {f.resolution}: {f.cause}" for f in report.failures)]
    parts += [
        "## Not measured",
        "`incline`: the worlds have no gravity; sliding friction is measured by `sliding_force` instead.",
    ]
    return "\n\n".join(parts) + "\n"


def _setting(report: Report) -> str:
    facts = report.metadata
    machine = facts.machine
    loads = [load for load in (machine.load_before, machine.load_after) if load is not None]
    load = "load average unknown" if not loads else f"load average {' to '.join(f'{each[0]:.1f}' for each in loads)}"
    commit = (
        "no commit" if facts.commit is None else f"commit {facts.commit}{' with changes' if facts.modified else ''}"
    )
    versions = ", ".join(f"{name} {version}" for name, version in facts.versions.items())
    if facts.changed:
        commit += ", **and the code changed while this ran**: not all rows are of one version"
    return (
        f"{machine.cpu}, {machine.cores} cores, {machine.system}; {load} (others worked on the machine if it is above "
        f"the number of cores; compare CPU s then). {facts.date:%Y-%m-%d}, {commit}; {versions}."
    )


def _remarks(rows: Sequence[Row]) -> list[str]:
    """What each case is, what its error is measured against, notes, costs of substeps."""
    lines = []
    for case, method in dict.fromkeys((row.case, row.method) for row in rows):
        same = [row for row in rows if (row.case, row.method) == (case, method)]
        against = "; ".join(dict.fromkeys(row.against for row in same))
        words = f"- **{case}, {method}**: {description(same[0].group, case, method)} Error against: {against}."
        notes = dict.fromkeys(row.note for row in same if row.note)
        words += "".join(f" Note: {note}." for note in notes)
        words += "".join(f" {row.resolution}: {', '.join(cost)}." for row in same if (cost := costs(row)))
        lines.append(words)
    return ["\n".join(lines)]


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def draw(rows: Sequence[Row], path: Path) -> None:
    """Time against error on logarithmic axes, a panel a case, a colour a method; lower left is better.

    Raises OSError.
    """
    from tacsim.figure import canvas, plain, save

    panels = [(panel, _points(rows, *panel[:2])) for panel in PANELS]
    shown = [(panel, points) for panel, points in panels if points] or [(PANELS[0], [])]
    methods = list(dict.fromkeys(row.method for _, points in shown for row in points))
    figure = canvas(4.6 * len(shown), 3.8)
    figure.set_layout_engine("constrained")
    for index, ((_, _, title, unit), points) in enumerate(shown):
        axes = plain(figure.add_subplot(1, len(shown), index + 1), title, "seconds (wall)", unit)
        axes.set(xscale="log", yscale="log")
        for row in points:
            colour = f"C{methods.index(row.method)}"
            axes.plot(row.seconds, row.error, "o", color=colour)
            words = f"{row.method}\n{row.resolution.partition(',')[0]}"
            axes.annotate(words, (row.seconds, row.error), (5, 4), textcoords="offset points", fontsize=7, color=colour)
        if points:
            axes.set_xlim(*_decades([row.seconds for row in points]))
            axes.set_ylim(*_decades([row.error for row in points]))
    save(figure, path)


def _decades(values: Sequence[float]) -> tuple[float, float]:
    """Whole powers of ten round `values`, so that each axis has at least two numbers on it."""
    return 10.0 ** math.floor(math.log10(min(values) / 1.2)), 10.0 ** math.ceil(math.log10(max(values) * 1.2))


def _points(rows: Iterable[Row], case: str, variant: str) -> list[Row]:
    """A logarithmic axis shows no zero: such a row is left to the table."""
    return [
        row for row in rows
        if row.case == case and (not variant or row.variant == variant) and row.error > 0 and row.seconds > 0
    ]  # fmt: skip

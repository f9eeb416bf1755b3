"""docs/benchmarks.md, the pages in docs/benchmarks/, and their pictures, from a report."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from benchmarks.cases.registry import description
from benchmarks.harness.schema import Machine, Report, Row
from benchmarks.pages import oracles, targets
from benchmarks.pages.picture import PICTURE, RADII, VERDICTS, draw, draw_radii, draw_verdicts

GROUP_WORDS = {
    "press": "Press: a rigid indenter on one gel",
    "squeeze": "Squeeze: plasticine between two gels",
    "materials": "Materials: laws, elements, transfers, and the cost of a substep",
    "scenes": "Scenes: cost by their content",
    "oracles": "Oracles: our results next to those of independent solvers",
    "real": "Real: frames of real sensors, and their cost",
}
COLUMNS = ("case", "method", "resolution", "seconds", "CPU s", "error", "MB", "substeps")

INDEX = "benchmarks.md"
FIGURES_PAGE = "benchmarks/figures.md"
FIGURES = (
    "Requirements and aims of the project, from the rows of the tables: the worst row of each kind, ratios within this "
    "run. "
    "*missed* is beyond *must*; *not measured* means that this run has no such row."
)
READING = (
    "- **A row** is one measurement by one method at one resolution. `tacsim` is ours; `seed`, `textbook`, "
    "`tacchi-settings` and `layer` are methods for comparison. The error belongs to the same run as the seconds: a "
    "fast row with a large error is not fast.\n"
    "- **Time.** Compare seconds of one run only. On a busy machine compare CPU s, or ratios; rows of one case "
    "ran one after the other.\n"
    "- **Error** is relative to the reference under each table: a closed form, a limit of fine meshes, a symmetry, or "
    "the same mesh at a speed without influence.\n"
    "- **Rerun** one group with `tacsim bench squeeze --json squeeze.json`; the last of the figures gives its "
    "time (slow limits are cached). Other methods need `--baselines`, our own long rows (fine "
    "meshes, `standard` squeezes, the incline, 100,000 substeps of rest; of real presses punches, invariance and all "
    "but the first set of balls) `--long`; both take "
    "many minutes. These pages: `tacsim bench all --baselines --long --json benchmarks/reference.json`, then "
    "`tacsim bench --from benchmarks/reference.json --docs docs`, with `--from "
    "benchmarks/gpu/report.json` too if it exists. That is the report of a GPU: `python -m benchmarks.device_run --all "
    "--budget 7200 --json benchmarks/gpu/report.json` measures it.\n"
    "- **Real frames** are not shipped. `tacsim bench real --data DIR` finds those of the public set named in "
    "`benchmarks/references/presses.yaml` by their names anywhere below DIR; a `presses.yaml` in DIR itself describes "
    "other presses, on any sensor. With `all`, `--data DIR` adds the group to the rest. Rows ending in `image` compare "
    "the circle in the real frame with that in our picture, found by the same fit; rows ending in `pressure` compare "
    "our contact itself with the radius in the labels. Films of dotted gels under a press are found in the same way, "
    "by `films.yaml`: the share of their dots that is tracked to the end, the jitter of the dots at rest, and the time "
    "of a frame. Presses of a ball are described by `balls.yaml`; `light` in `presses.yaml` names those by which the "
    "sensor of the known depths is calibrated. *null* next to an error is the error without contact. "
    "*Not measured* lists the frames that the folder lacks."
)


WRITTEN = "Written by `tacsim bench --from FILE --docs docs`; do not edit."
MEASURED = (
    "Every row is time, error and memory of one run, kernels compiled before the clock starts; another method and "
    "every long case has a process of its own, our other cases of a group share one. Seconds are the median of wall "
    "time ± interquartile range (none with fewer than three repetitions), CPU s the processor time of all threads."
)
ON_DEVICE = (
    "Kernels ran on the device; the processor renders the images, and MB is the memory of the process. "
    "*CPU / GPU* is seconds of the same row on the CPU over seconds here: two runs, possibly on two machines."
)
NO_DEVICE = "No GPU has been measured yet: with CUDA, `make test-gpu` measures it."


def cells(row: Row) -> list[str]:
    """A row of the table, as text."""
    name = row.case if not row.variant else f"{row.case}: {row.variant}"
    spread = "" if row.spread is None else f" ± {row.spread:.2g}"
    substeps = "" if row.substeps is None else str(row.substeps)
    error = f"{row.error:.3g} {row.error_unit}"
    null = next((value for name, value in row.figures.items() if name.startswith("null")), None)
    error += "" if null is None else f" (null {null:.3g})"
    return [
        name, row.method, row.resolution, f"{row.seconds:.3g}{spread}", f"{row.cpu_seconds:.3g}", error,
        f"{row.peak_mb:.0f}", substeps,
    ]  # fmt: skip


def costs(row: Row) -> list[str]:
    """The cost of a substep for each particle or element, as text."""
    found = []
    for name, value in row.figures.items():
        kind, per, rest = name.partition("_per_")
        what, substep, unit = rest.rpartition("_substep_")
        if per and substep:
            found.append(f"{value:.0f} {unit.replace('us', 'µs')} {kind} a substep and {what}")
    return found


def write_pages(report: Report, folder: Path, devices: Sequence[Report] = ()) -> list[Path]:
    """Writes the pages, and their pictures into images/, below `folder`; returns their paths. Raises OSError."""
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    draw(report.results, images / PICTURE)
    draw_verdicts(report.results, images / VERDICTS)
    pictures = [images / PICTURE, images / VERDICTS]
    if draw_radii(report.results, images / RADII):
        pictures.append(images / RADII)
    written = []
    for name, text in pages(report, devices).items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
        written.append(path)
    return [*written, *pictures]


def pages(report: Report, devices: Sequence[Report] = ()) -> dict[str, str]:
    """The pages of a report of the CPU and of reports of devices, by path: an index, the figures, a page for each group
    and for each device. The same reports give the same text."""
    found = {FIGURES_PAGE: _join(_figures(report))}
    for group in GROUP_WORDS:
        if any(row.group == group for row in report.results):
            found[f"benchmarks/{group}.md"] = _join(_of_group(group, report))
    for title in dict.fromkeys(_title(each) for each in devices):
        name = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")
        parts = _on_device(title, [each for each in devices if _title(each) == title], report)
        found[f"benchmarks/gpu-{name}.md"] = _join(parts)
    return {INDEX: _join(_index(report, found, has_device=bool(devices))), **found}


def _join(parts: Sequence[str]) -> str:
    return "\n\n".join(parts) + "\n"


def _index(report: Report, others: Mapping[str, str], *, has_device: bool) -> list[str]:
    """The first page: pictures, the list of the other pages, and how to read them."""
    rows = []
    for name, text in others.items():
        title = text.partition("\n")[0].removeprefix("# ")
        group = Path(name).stem
        count = "" if group not in GROUP_WORDS else str(sum(row.group == group for row in report.results))
        rows.append([f"[{title}]({name})", count])
    return [
        "# Benchmarks",
        f"{WRITTEN} Speed and error of tacsim next to other methods. Each page has the rows of one group.",
        f"![Time against error, by method](images/{PICTURE})",
        "*Lower left is better. `tacchi-settings`: one shared particle grid at the settings of Tacchi; `layer`: an "
        "elastic layer by FFT; `seed`: the seed paper's scheme; `textbook`: MLS-MPM as in textbooks.*",
        f"![Each figure over its requirement, by verdict](images/{VERDICTS})",
        "*Each figure of the project, divided by its requirement. Left of the line it is met. "
        f"[All figures]({FIGURES_PAGE}).*",
        table(("page", "rows"), rows),
        "## How to read and rerun",
        MEASURED,
        READING,
        "## Machine",
        setting(report),
        *(["## Failed", _failures(report)] if report.failures else []),
        "## Not measured",
        *(["\n".join(f"- {m.case}: {m.cause}" for m in report.missing)] if report.missing else []),
        "Whether hard cases end their process is counted by a test, `test_no_case_ended_the_process` in "
        "`tests/stability`.",
        *([] if has_device else [NO_DEVICE]),
    ]


def _figures(report: Report) -> list[str]:
    """The page of the requirements and aims."""
    lines = [*targets.lines(report.results), slowest_group(report)]
    return ["# Requirements and aims", f"{WRITTEN} {FIGURES}", setting(report), table(targets.HEADER, lines)]


def _of_group(group: str, report: Report) -> list[str]:
    """The page of one group of cases."""
    rows = [row for row in report.results if row.group == group]
    parts = [f"# {GROUP_WORDS[group]}", f"{WRITTEN} [How to read the rows](../{INDEX}#how-to-read-and-rerun)."]
    if group == "real":
        parts.append(f"![Contact radius against depth: real, ours, and simpler theories](../images/{RADII})")
    text = table(*oracles.lines(rows)) if group == "oracles" else table(COLUMNS, map(cells, rows))
    return [*parts, text, "## Cases", *_remarks(rows)]


def slowest_group(report: Report) -> list[str]:
    """The time of `tacsim bench GROUP`, which is in no row, as a line of the table."""
    seconds = report.metadata.group_seconds
    name = "a group without `--baselines` and `--long`"
    if seconds:
        name += f" ({', '.join(f'{group} {value:.0f} s' for group, value in seconds.items())})"
    slowest = max(seconds.values(), default=None)
    return targets.Target(name=name, unit="s", must=40).cells(slowest)


def _on_device(title: str, reports: Sequence[Report], cpu: Report) -> list[str]:
    """The page of one device."""
    usual = {_identity(row): row.seconds for row in cpu.results}

    def ratio(row: Row) -> str:
        seconds = usual.get(_identity(row))
        return "" if seconds is None or row.seconds == 0 else f"{seconds / row.seconds:.3g} x"

    parts = [f"# On a GPU: {title}", WRITTEN, *dict.fromkeys(map(setting, reports)), ON_DEVICE]
    for group, words in GROUP_WORDS.items():
        rows = [row for report in reports for row in report.results if row.group == group]
        if rows:
            lines = ([*cells(row), ratio(row)] for row in rows)
            parts += [f"## {words}", table((*COLUMNS, "CPU / GPU"), lines), *_remarks(rows)]
    failed = [_failures(report) for report in reports if report.failures]
    parts += ["## Failed there", *failed] if failed else []
    missing = [lack for report in reports for lack in report.missing]
    for cause in dict.fromkeys(lack.cause for lack in missing):
        cases = dict.fromkeys(f"{lack.case}, {lack.method}" for lack in missing if lack.cause == cause)
        parts.append(f"Not measured there ({cause}): {'; '.join(cases)}.")
    return parts


def _title(report: Report) -> str:
    device = report.metadata.machine.device
    return "" if device is None else device.title


def _identity(row: Row) -> tuple[str, ...]:
    """The key that identifies the same measurement in two runs."""
    return row.group, row.case, row.variant, row.method, row.resolution


def _failures(report: Report) -> str:
    return "\n".join(f"- {f.case}, {f.method}, {f.resolution}: {f.cause}" for f in report.failures)


def setting(report: Report) -> str:
    """Machine, load, date, commit and versions of a run, as text."""
    config = report.metadata
    machine = config.machine
    loads = [load for load in (machine.load_before, machine.load_after) if load is not None]
    load = "load average unknown" if not loads else f"load average {' to '.join(f'{each[0]:.1f}' for each in loads)}"
    commit = (
        "no commit" if config.commit is None else f"commit {config.commit}{' with changes' if config.modified else ''}"
    )
    versions = ", ".join(f"{name} {version}" for name, version in config.versions.items())
    if config.changed:
        commit += ", **and the code changed while this ran**: not all rows are of one version"
    return (
        f"{_hardware(machine)}; {load} (if it is above the number of cores, other programs used the machine; then "
        f"compare CPU s). {config.date:%Y-%m-%d}, {commit}; {versions}."
    )


def _hardware(machine: Machine) -> str:
    """Processor and, if kernels ran on one, device."""
    host, device = f"{machine.cpu}, {machine.cores} cores, {machine.system}", machine.device
    if device is None:
        return host
    memory = f", {device.memory_gb:g} GB" if device.memory_gb is not None else ""
    driver = f", driver {device.driver}" if device.driver is not None else ""
    return f"{device.title} ({device.backend}{memory}{driver}) next to {host}"


def _remarks(rows: Sequence[Row]) -> list[str]:
    """Description of each case, reference of its error, notes, and cost of its substeps."""
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


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])

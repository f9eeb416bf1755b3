"""Report of an episode: `summary.json`, `report.png`, and `report.html` (one file, nothing from outside)."""

from __future__ import annotations

import base64
import json
import math
import statistics
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tacsim.record.episode import Episode
from tacsim.report.diagnostics import timing, timing_rows, trust, trust_rows

if TYPE_CHECKING:
    from rich.table import Table

FILMSTRIP = 12  # frames a sensor in report.html
THUMBNAIL = 320  # [px]


def summary(episode: Episode) -> dict[str, Any]:
    """An episode in numbers, as JSON; lists have one entry for each control step (none for the state after reset).

    `reward` [-], `distance` [m], `force` (arm -> |Fz| [N]), `seconds` [s], `contact_signal` (sensor -> list),
    `correlation` (sensor -> r between contact signal and force), `timing` (tacsim.report.diagnostics; null unless the
    rig is live), `trust` (the same; null if sensors know their surface). Unknown and infinite values are null.
    """
    from tacsim.report.figure import contact_signals, normal_force, signal_against_force

    meta, done = episode.meta, [step for step in episode.steps if step.index > 0]
    signals = contact_signals(Episode(meta, done))
    settled = [bool(step.info["settled"]) for step in done if "settled" in step.info]
    return {
        "rig": meta.rig,
        "task": meta.task,
        "policy": meta.policy,
        "seed": meta.seed,
        "goal": list(meta.goal) if isinstance(meta.goal, tuple) else meta.goal,
        "steps": len(done),
        "step": [step.index for step in done],
        "reward": [_number(step.reward) for step in done],
        "distance": [_number(step.distance) for step in done],
        "force": [{name: _number(value) for name, value in normal_force(step).items()} for step in done],
        "contact_signal": {name: [_number(value) for value in values] for name, values in signals.items()},
        "correlation": {name: _number(pair[2]) for name, pair in signal_against_force(episode).items()},
        "seconds_per_step": _number(statistics.median(step.seconds for step in done)) if done else None,
        "seconds": [_number(step.seconds) for step in done],
        "settled": sum(settled) if settled else None,
        "timing": timing(episode),
        "trust": trust(episode),
        "complete": episode.complete,
        "dropped": episode.dropped,
        "versions": dict(meta.versions),
    }


def write_report(episode: Episode, directory: Path) -> dict[str, Path]:
    """Writes `summary.json`, `report.png` and `report.html` into `directory`; returns their paths by name.

    Raises OSError when the directory can't be written, ValueError for an episode without steps.
    """
    from tacsim.report import figure

    if not episode.steps:
        raise ValueError("the episode has no steps, there is nothing to report; record at least the state after reset")
    stats = summary(episode)
    paths = {name: directory / name for name in ("summary.json", "report.png", "report.html")}
    directory.mkdir(parents=True, exist_ok=True)
    paths["summary.json"].write_text(json.dumps(stats, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    subtitle = " · ".join(f"{key}: {value}" for key, value in _headline(stats, episode))
    figure.save(figure.overview(episode, _title(stats), subtitle), paths["report.png"])
    paths["report.html"].write_text(_html(episode, stats), encoding="utf-8")
    return paths


def end_table(stats: Mapping[str, Any], paths: Iterable[Path]) -> Table:
    """The summary of a run for the terminal. `stats` are those of :func:`summary`."""
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(_title(stats)), show_header=False, title_justify="left", min_width=60)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in _results(stats):
        table.add_row(name, Text(value))
    for number, path in enumerate(paths):
        table.add_row("files" if number == 0 else "", Text(str(path)))
    return table


def _results(stats: Mapping[str, Any]) -> list[tuple[str, str]]:
    known = [(value, k) for k, value in zip(stats["step"], stats["distance"], strict=True) if value is not None]
    best = min(known, default=None)
    rewards = [value for value in stats["reward"] if value is not None]
    rows_of_force = zip(stats["step"], stats["force"], strict=True)
    forces = [(value, arm, k) for k, row in rows_of_force for arm, value in row.items() if value is not None]
    peak = max(forces, key=lambda row: row[0], default=None)  # of equal ones the first
    rows = [
        ("steps", f"{stats['steps']}" + ("" if stats["complete"] else " (recording incomplete)")),
        ("best distance", f"{best[0] * 1e3:.3f} mm at step {best[1]}" if best else "–"),
        ("final reward", f"{rewards[-1]:.3f}" if rewards else "–"),
        ("peak force |Fz|", f"{peak[0]:.2f} N ({peak[1]}, step {peak[2]})" if peak else "–"),
        ("contact signal", _signal_text(stats)),
        ("step time, median", f"{stats['seconds_per_step']:.3f} s" if stats["seconds_per_step"] is not None else "–"),
    ]
    if stats["settled"] is not None:
        rows.append(("settled", f"{stats['settled']} of {stats['steps']} steps"))
    if stats["timing"] is not None:
        rows += timing_rows(stats["timing"])
    if stats["trust"] is not None:
        rows += trust_rows(stats["trust"])
    if stats["dropped"]:
        rows.append(("dropped", f"{stats['dropped']} steps were not recorded"))
    return rows


def _signal_text(stats: Mapping[str, Any]) -> str:
    parts = []
    for name, values in stats["contact_signal"].items():
        known = [value for value in values if value is not None]
        if known:
            correlation = stats["correlation"].get(name)
            with_force = "" if correlation is None else f", r = {correlation:.3f} with force"
            parts.append(f"{name}: peak {max(known):.3g}{with_force}")
    return "; ".join(parts) or "–"


def _title(stats: Mapping[str, Any]) -> str:
    return f"{stats['task'] or 'episode'} on rig {stats['rig']}"


def _headline(stats: Mapping[str, Any], episode: Episode) -> list[tuple[str, str]]:
    from tacsim.report.figure import goal_text

    return [
        ("policy", str(stats["policy"])),
        ("seed", str(stats["seed"])),
        ("steps", str(stats["steps"])),
        ("goal", goal_text(episode.meta.goal)),
    ]


def _number(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _inline(content: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(content).decode("ascii")


def _html(episode: Episode, stats: Mapping[str, Any]) -> str:
    from jinja2 import Environment, StrictUndefined

    from tacsim.report import figure

    strips = []
    for name in figure.sensors_of(episode):
        seen = [step for step in episode.steps if name in step.frames]
        shown = [seen[k] for k in figure.moments(len(seen), FILMSTRIP)]
        images = [(step.index, _inline(figure.png(step.frames[name].image, THUMBNAIL))) for step in shown]
        strips.append({"name": name, "frames": images, "total": len(seen)})
    template = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    ).from_string(Path(__file__).with_name("report.html.jinja").read_text(encoding="utf-8"))
    return template.render(
        title=_title(stats),
        about=[("rig", stats["rig"]), ("task", stats["task"] or "–"), *_headline(stats, episode)],
        results=_results(stats),
        versions=sorted(stats["versions"].items()),
        strips=strips,
        plots=_inline(figure.png_of(figure.plots(episode))),
    )

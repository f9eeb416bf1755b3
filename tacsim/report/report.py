"""Report of an episode: `summary.json`, `report.png`, and `report.html` (one file, without external parts)."""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tacsim.interface import FloatArray, SurfaceMap, TactileFrame, TactileObservation
from tacsim.models.task import unit_of
from tacsim.record.episode import SETTLED, Episode
from tacsim.report.series import (
    Series,
    sensor_diagnostics,
    sensor_warnings,
    timing_rows,
    timing_statistics,
    training_range_statistics,
    training_rows,
)

if TYPE_CHECKING:
    from markupsafe import Markup
    from rich.table import Table

    from tacsim.report.section import GelShape
    from tacsim.report.strips import Find, Known, Strip

# Of the gels: key in the summary, label, and displayed unit
SURFACE = (
    ("deepest", "deepest", 1e3, " mm"),
    ("steepest", "steepest slope", 1.0, ""),
    ("flow", "longest flow", 1e3, " mm"),
)


def summarise(series: Series, *, complete: bool = True, dropped: int = 0) -> dict[str, Any]:
    """An episode in numbers, as JSON; lists have one entry for each control step (none for the state after reset).

    `reward` [-], `distance` [m], `felt_distance` (the tactile estimate [m]), `force` (arm -> |Fz| [N]), `seconds`
    [s], `contact_signal` (sensor -> list), `deepest` point and longest `flow` of a gel (sensor -> list [m]), its
    `steepest` slope (sensor -> list), `correlation` (sensor -> r between contact signal and force), `timing`
    (tacsim.report.series; null unless the rig is live), `trust` (the same; null if sensors give their surface),
    `training_range` (the same; null for a policy that is not learned),
    `started` (ISO date and time with its zone).
    Unknown and infinite values are null.
    """
    from tacsim.report.figure import signal_against_force

    meta, done = series.meta, series.after_reset()
    settled = done.info.get(SETTLED)
    force = {name: _json_numbers(values) for name, values in done.force.items()}
    present = {name: ~np.isnan(values) for name, values in done.force.items()}
    return {
        "rig": meta.rig,
        "task": meta.task,
        "policy": meta.policy,
        "seed": meta.seed,
        "goal": [json_number(each) for each in meta.goal] if isinstance(meta.goal, tuple) else json_number(meta.goal),
        "started": None if meta.started is None else meta.started.isoformat(timespec="milliseconds"),
        "steps": len(done),
        "step": done.index.tolist(),
        "reward": _json_numbers(done.reward),
        "distance": _json_numbers(done.distance),
        "felt_distance": _json_numbers(done.tactile_distance),
        "force": [{name: force[name][at] for name in force if present[name][at]} for at in range(len(done))],
        "contact_signal": {name: _json_numbers(values) for name, values in done.signals.items()},
        "deepest": {name: _json_numbers(values) for name, values in done.max_depth.items()},
        "steepest": {name: _json_numbers(values) for name, values in done.max_slope.items()},
        "flow": {name: _json_numbers(values) for name, values in done.max_flow.items()},
        "correlation": {name: pair[2] for name, pair in signal_against_force(series).items()},
        "seconds_per_step": json_number(np.median(done.seconds)) if len(done) else None,
        "seconds": _json_numbers(done.seconds),
        "settled": None if settled is None else int(np.count_nonzero(np.nan_to_num(settled))),
        "timing": timing_statistics(series),
        "trust": sensor_diagnostics(series),
        "training_range": training_range_statistics(series),
        "complete": complete,
        "dropped": dropped,
        "versions": dict(meta.versions),
    }


def write_report(
    episode: Episode,
    directory: Path,
    find: Callable[[str, TactileFrame], SurfaceMap | TactileObservation | None] = lambda sensor, frame: frame.surface,
    gels: Mapping[str, GelShape] | None = None,
) -> dict[str, Path]:
    """Writes `summary.json`, `report.png` and `report.html` into `directory`; returns their paths by name. The steps of
    a recording are read one by one, so that a long episode takes little memory.

    find: returns the surface of a sensor's gel in a frame, if known; by default the surface in the frame. It is called
    once for a frame, in the order of time. gels: the shape of each gel that is drawn with the body.

    Raises OSError if the directory cannot be written, ValueError for an episode without steps, EpisodeError for a
    recording that cannot be read.
    """
    from tacsim.report import figure
    from tacsim.report.playback import moments_of, playback_data
    from tacsim.report.strips import sensor_strips

    if not len(episode.steps):
        raise ValueError("the episode has no steps, there is nothing to report; record at least the state after reset")
    series = Series.from_episode(episode)
    stats = summarise(series, complete=episode.complete, dropped=episode.dropped)
    moments, find_once = moments_of(episode), _FindOnce(find)
    player = playback_data(episode, series, find_once, gels or {}, moments)
    rows = sensor_strips(episode, series, figure.COLUMNS, find_once, moments)
    paths = {name: directory / name for name in ("summary.json", "report.png", "report.html")}
    directory.mkdir(parents=True, exist_ok=True)
    subtitle = " · ".join(f"{key}: {value}" for key, value in _headline_rows(stats, series))
    shown_rows = [(row.label, row.pictures) for row in rows]
    try:
        paths["summary.json"].write_text(json.dumps(stats, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        figure.save_figure(
            figure.draw_overview(shown_rows, series, _report_title(stats), subtitle), paths["report.png"]
        )
        paths["report.html"].write_text(_render_html(player, series, stats, rows), encoding="utf-8")
    except OSError:  # such as a full disk: an incomplete report is removed
        for path in paths.values():
            path.unlink(missing_ok=True)
        raise
    return paths


def summary_table(stats: Mapping[str, Any], paths: Iterable[Path]) -> Table:
    """The summary of a run for the terminal. `stats` are those of :func:`summarise`."""
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(_report_title(stats)), show_header=False, title_justify="left", min_width=60)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in _result_rows(stats):
        table.add_row(name, Text(value))
    for number, path in enumerate(paths):
        table.add_row("files" if number == 0 else "", Text(str(path)))
    return table


def _result_rows(stats: Mapping[str, Any]) -> list[tuple[str, str]]:
    best, tactile = (_describe_min(stats, key) for key in ("distance", "felt_distance"))
    rewards = [value for value in stats["reward"] if value is not None]
    rows_of_force = zip(stats["step"], stats["force"], strict=True)
    forces = [(value, arm, k) for k, row in rows_of_force for arm, value in row.items() if value is not None]
    peak = max(forces, key=lambda row: row[0], default=None)  # of equal ones the first
    rows = [
        ("steps", f"{stats['steps']}" + ("" if stats["complete"] else " (recording incomplete)")),
        *_task_rows(
            stats,
            [
                ("best distance", best),
                ("best distance, tactile", tactile),
                ("final reward", f"{rewards[-1]:.3f}" if rewards else "–"),
            ],
        ),
        *([("peak force |Fz|", f"{peak[0]:.2f} N ({peak[1]}, step {peak[2]})")] if peak else []),
        *_surface_rows(stats),
        ("contact signal", _signal_text(stats)),
        ("step time, median", f"{stats['seconds_per_step']:.3f} s" if stats["seconds_per_step"] is not None else "–"),
    ]
    if stats["settled"] is not None:
        rows.append(("settled", f"{stats['settled']} of {stats['steps']} steps"))
    if stats["timing"] is not None:
        rows += timing_rows(stats["timing"])
    if stats["training_range"] is not None:
        rows += training_rows(stats["training_range"])
    if stats["trust"] is not None:
        rows += sensor_warnings(stats["trust"])
    if stats["dropped"]:
        rows.append(("dropped", f"{stats['dropped']} steps were not recorded"))
    return rows


def _task_rows(stats: Mapping[str, Any], rows: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """`rows` for an episode with a task, otherwise none."""
    return [] if stats["task"] is None else rows


def _surface_rows(stats: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The largest known height, slope and flow of each gel."""
    found = []
    for key, words, scale, unit in SURFACE:
        parts = [
            f"{name} {scale * max(known)[0]:.3g}{unit} (step {max(known)[1]})"
            for name, values in stats[key].items()
            if (known := [(value, -k) for k, value in zip(stats["step"], values, strict=True) if value is not None])
        ]
        if parts:
            found.append((words, "; ".join(parts).replace("step -", "step ")))
    return found


def _describe_min(stats: Mapping[str, Any], key: str) -> str:
    known = [(value, k) for k, value in zip(stats["step"], stats[key], strict=True) if value is not None]
    return f"{unit_of(stats['task']).show(min(known)[0])} at step {min(known)[1]}" if known else "–"


def _signal_text(stats: Mapping[str, Any]) -> str:
    parts = []
    for name, values in stats["contact_signal"].items():
        known = [value for value in values if value is not None]
        if known:
            correlation = stats["correlation"].get(name)
            with_force = "" if correlation is None else f", r = {correlation:.3f} with force"
            parts.append(f"{name}: peak {max(known):.3g}{with_force}")
    return "; ".join(parts) or "–"


def _report_title(stats: Mapping[str, Any]) -> str:
    return f"{stats['task'] or 'episode'} on rig {stats['rig']}"


def _headline_rows(stats: Mapping[str, Any], series: Series) -> list[tuple[str, str]]:
    from tacsim.report.figure import goal_text

    lines = [
        ("policy", str(stats["policy"])),
        ("seed", str(stats["seed"])),
        ("steps", str(stats["steps"])),
        *_task_rows(stats, [("goal", goal_text(series.meta.goal, unit_of(series.meta.task)))]),
    ]
    started = stats["started"]
    return lines if started is None else [*lines, ("started", f"{started[:10]} {started[11:19]} {started[23:]}")]


def json_number(value: float | None) -> float | None:
    """The number for a JSON file: None if it is unknown or infinite."""
    return None if value is None or not math.isfinite(value) else float(value)


def _json_numbers(values: FloatArray) -> list[float | None]:
    return [json_number(value) for value in values.tolist()]


def data_url(content: bytes, kind: str = "png") -> str:
    """A picture of this kind as a data URL for a page."""
    return f"data:image/{kind};base64," + base64.b64encode(content).decode("ascii")


def render_page(template: Path, **values: Any) -> str:
    """The HTML page of a Jinja template with these values; texts are escaped."""
    from jinja2 import Environment, StrictUndefined

    page = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return page.from_string(template.read_text(encoding="utf-8")).render(**values)


def _render_html(recorded: Mapping[str, Any], series: Series, stats: Mapping[str, Any], strips: Sequence[Strip]) -> str:
    from tacsim.report import figure

    script = Path(__file__).with_name("player.js").read_text(encoding="utf-8")
    return render_page(
        Path(__file__).with_name("report.html.jinja"),
        title=_report_title(stats),
        about=[("rig", stats["rig"]), *_task_rows(stats, [("task", stats["task"])]), *_headline_rows(stats, series)],
        results=_result_rows(stats),
        versions=sorted(stats["versions"].items()),
        strips=[
            {
                "title": strip.title,
                "note": strip.note,
                "frames": [
                    (picture.index, data_url(figure.encode_jpeg(picture.image), "jpeg")) for picture in strip.pictures
                ],
            }
            for strip in strips
        ],
        plots=data_url(figure.encode_figure(figure.draw_plots(series))),
        episode=to_script_json(recorded),
        script=script_text(script),
        script_hash=script_hash(script),
    )


def to_script_json(data: Mapping[str, Any]) -> Markup:
    """JSON for a page's <script> element: no text in it can end the element."""
    from markupsafe import Markup

    return Markup(json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"))


def script_text(script: str) -> Markup:
    """A script of ours for a page's <script> element."""
    from markupsafe import Markup

    return Markup(script)


def script_hash(script: str) -> str:
    """What a page's Content-Security-Policy allows it by, after `sha256-`."""
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")


class _FindOnce:
    """Remembers surfaces, so that the second reader of a frame does not go back in time."""

    def __init__(self, find: Find) -> None:
        self._find = find
        self._found: dict[tuple[str, int, float], Known | None] = {}

    def __call__(self, sensor: str, frame: TactileFrame) -> Known | None:
        key = sensor, frame.index, frame.time
        if key not in self._found:
            self._found[key] = self._find(sensor, frame)
        return self._found[key]

"""Pictures of a report: time against error by method; contact radius against depth, real and simulated."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.harness.schema import Row
from benchmarks.pages.targets import TARGETS, Target

PICTURE = "speed_vs_error.png"
RADII = "contact_radius.png"
VERDICTS = "figures.png"
VERDICT_COLOURS = {"aim met": "C2", "met": "C0", "aim missed": "C1", "missed": "C3"}
# of each panel: case, variant ("" for any), title, unit of the error
PANELS = (
    ("sphere_press", "", "Ball R 4 mm, 1 mm deep", "error of the surface [µm rms]"),
    ("settled_squeeze", "", "3 mm squeeze, settled", "force against one slow limit, of standard [%]"),
    ("plasticine_step", "", "Yield of a 10 mm cube", "error of the stress [%]"),
)
# contact radii: figure of the row, words, colour, style
CURVES = (
    ("cap_px", "cap cut by the rest plane (depth map)", "C7", ":"),
    ("hertz_px", "Hertz, half-space", "C2", "--"),
    ("layer_px", "FFT elastic layer", "C1", "-."),
    ("pressure_px", "ours, contact pressure", "C0", "-"),
)
DOTS = (
    ("image_px", "ours, circle in our image", "C0", "s"),
    ("real_px", "real, circle in the frame, same fit", "k", "o"),
    ("label_px", "real, as labelled", "k", "+"),
)


def draw(rows: Sequence[Row], path: Path) -> None:
    """Time against error on logarithmic axes, a panel for each case, a colour for each method; lower left is better.

    Raises OSError.
    """
    from tacsim.report.figure import new_figure, save_figure, style_axes

    panels = [(panel, _points(rows, *panel[:2])) for panel in PANELS]
    drawn = [(panel, points) for panel, points in panels if points] or [(PANELS[0], [])]
    methods = list(dict.fromkeys(row.method for _, points in drawn for row in points))
    figure = new_figure(4.1 * len(drawn), 3.8)
    figure.set_layout_engine("constrained")
    for index, ((_, _, title, unit), points) in enumerate(drawn):
        axes = style_axes(figure.add_subplot(1, len(drawn), index + 1), title, "seconds (wall)", unit)
        axes.set(xscale="log", yscale="log")
        if not points:
            continue
        axes.set_xlim(*_decades([row.seconds for row in points]))
        axes.set_ylim(*_decades([row.error for row in points]))
        places = axes.transAxes.inverted().transform(axes.transData.transform([(r.seconds, r.error) for r in points]))
        for row, place in zip(points, places, strict=True):
            colour = f"C{methods.index(row.method)}"
            axes.plot(row.seconds, row.error, "o", color=colour)
            words = f"{row.method}\n{row.resolution.partition(',')[0]}"
            left, below = place[0] > 0.7, any(_close_above(place, other) for other in places)
            axes.annotate(
                words, (row.seconds, row.error), (-5 if left else 5, -4 if below else 4), textcoords="offset points",
                ha="right" if left else "left", va="top" if below else "bottom", fontsize=7, color=colour,
            )  # fmt: skip
    save_figure(figure, path)


def _close_above(place: Sequence[float], other: Sequence[float]) -> bool:
    """True if labels at two places in a panel, from 0 to 1 across it, would overlap."""
    return abs(other[0] - place[0]) < 0.3 and 0.0 < other[1] - place[1] < 0.2


def _decades(values: Sequence[float]) -> tuple[float, float]:
    """Powers of ten around `values`, so that each axis has at least two labels."""
    return 10.0 ** math.floor(math.log10(min(values) / 1.2)), 10.0 ** math.ceil(math.log10(max(values) * 1.2))


def _points(rows: Iterable[Row], case: str, variant: str) -> list[Row]:
    """The rows of a panel, without zeros, which a logarithmic axis cannot show."""
    return [
        row for row in rows
        if row.case == case and (not variant or row.variant == variant) and row.error > 0 and row.seconds > 0
    ]  # fmt: skip


def draw_verdicts(rows: Sequence[Row], path: Path, targets: Iterable[Target] = TARGETS) -> None:
    """Each figure over its requirement (or, without one, its aim), sorted, a colour for each verdict.

    A figure that must be large is turned round: in the picture, less is better for all. Raises OSError.
    """
    from tacsim.report.figure import new_figure, save_figure, style_axes

    found = sorted(
        ((share, each) for each in targets if (share := _share_of_limit(each, rows)) is not None),
        key=lambda pair: pair[0],
    )
    figure = new_figure(10, 3.6)
    figure.set_layout_engine("constrained")
    words = "below 1: within the requirement (without one: the aim)"
    axes = style_axes(figure.add_subplot(), "Figures over their requirements", words, "figures")
    axes.set(xscale="log", yticks=[])
    axes.axvline(1.0, color="k", linewidth=0.8)
    for verdict, colour in VERDICT_COLOURS.items():
        here = [(share, k) for k, (share, target) in enumerate(found) if target.evaluate(target.find(rows)) == verdict]
        if here:
            axes.plot(*zip(*here, strict=True), "o", color=colour, markersize=4, label=f"{verdict}: {len(here)}")
    if found:
        axes.legend(fontsize=8, frameon=False, loc="lower right")
    save_figure(figure, path)


def _share_of_limit(target: Target, rows: Sequence[Row]) -> float | None:
    """The value over the limit, turned round where more is better; None without a value, or where it is zero."""
    limit = target.aim if target.must is None else target.must
    value = target.find(rows)
    if not value or not limit:
        return None
    return limit / value if target.is_min_limit else value / limit


def draw_radii(rows: Sequence[Row], path: Path) -> bool:
    """Contact radius against depth, a panel for each ball, of the first gel in `rows`. Returns False without such rows.

    Raises OSError.
    """
    from tacsim.report.figure import new_figure, save_figure, style_axes

    found = [row for row in rows if row.group == "real" and "thickness_mm" in row.figures]
    if not found:
        return False
    thickness = found[0].figures["thickness_mm"]
    found = [row for row in found if row.figures["thickness_mm"] == thickness]
    balls = sorted({row.figures["ball_radius_mm"] for row in found})
    figure = new_figure(4.8 * len(balls), 4.2)
    figure.set_layout_engine("constrained")
    for index, ball in enumerate(balls):
        words = f"Ball R {ball:g} mm, gel {thickness:g} mm thick"
        axes = style_axes(figure.add_subplot(1, len(balls), index + 1), words, "depth [mm]", "contact radius [px]")
        here = [row for row in found if row.figures["ball_radius_mm"] == ball]
        for name, label, colour, style in CURVES:
            axes.plot(*_against_depth(here, name), style, color=colour, label=label, linewidth=1.2)
        for name, label, colour, marker in DOTS:
            depth, radius = _against_depth(here, name)
            if depth:
                axes.plot(depth, radius, marker, color=colour, label=label, markerfacecolor="none", markersize=8)
        uncertainty = max(row.figures.get("depth_uncertainty_mm", 0.0) for row in here)
        if uncertainty > 0:
            depth, radius = _against_depth(here, "real_px")
            axes.errorbar(depth, radius, xerr=uncertainty, fmt="none", ecolor="k", elinewidth=0.8, capsize=2)
        axes.set_xlim(left=0)
        axes.set_ylim(bottom=0)
        if index == 0:
            axes.legend(fontsize=7, frameon=False, loc="lower right")
    save_figure(figure, path)
    return True


def _against_depth(rows: Iterable[Row], name: str) -> tuple[list[float], list[float]]:
    """Depths [mm] and values of one figure, each depth once."""
    at = {row.figures["depth_mm"]: row.figures[name] for row in rows if name in row.figures}
    return sorted(at), [at[depth] for depth in sorted(at)]

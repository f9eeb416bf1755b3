"""The drawings of the pages, as SVG files in docs/images: python -m tools.site.drawings

frames.svg: the frames of a rig with two arms. setups.svg: three set-ups. mock.svg: what stands behind mock hardware.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib

from tools.site.pages import ROOT

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GEL, BODY, GREY, INK, TEXT = "#f6b48f", "#8fb8de", "#b0bec5", "#37474f", "#212121"
AXES = {"x": "#d32f2f", "y": "#388e3c", "z": "#1976d2"}


def new_axes(figure: Figure, place: int, columns: int, title: str) -> Axes:
    axes = figure.add_subplot(1, columns, place)
    axes.set_aspect("equal")
    axes.axis("off")
    axes.set_title(title, fontsize=10, color=TEXT)
    return axes


def box(axes: Axes, x: float, y: float, width: float, height: float, colour: str) -> None:
    """A rectangle around the point x, y."""
    from matplotlib.patches import Rectangle

    axes.add_patch(Rectangle((x - width / 2, y - height / 2), width, height, facecolor=colour, edgecolor=INK, lw=0.8))


def sensor(axes: Axes, x: float, y: float, up: float) -> None:
    """A sensor whose gel surface is at x, y; it faces up (1) or down (-1)."""
    box(axes, x, y - 0.2 * up, 2.0, 0.4, GEL)
    box(axes, x, y - 0.85 * up, 2.2, 0.9, GREY)


def frame(axes: Axes, origin: tuple[float, float], right: str, up: str, name: str, *, signs: tuple[int, int]) -> None:
    """Two arrows along the axes named `right` and `up`, with these signs, and the name of the frame."""
    x, y = origin
    for axis, (dx, dy) in ((right, (signs[0], 0)), (up, (0, signs[1]))):
        axes.annotate(
            "", (x + 0.9 * dx, y + 0.9 * dy), (x, y), arrowprops={"arrowstyle": "-|>", "color": AXES[axis], "lw": 1.8}
        )
        axes.text(x + 1.08 * dx, y + 1.08 * dy, axis, color=AXES[axis], ha="center", va="center", fontsize=9)
    axes.plot(x, y, "o", color=INK, ms=4)
    axes.text(x - 0.18, y - 0.12 * signs[1], name, color=TEXT, ha="right", va="center", fontsize=8.5)


def arm(axes: Axes, base: tuple[float, float], elbow: tuple[float, float], hand: tuple[float, float]) -> None:
    """Links of an arm from its base to its hand."""
    axes.plot(*zip(base, elbow, hand, strict=True), color=GREY, lw=9, solid_capstyle="round", zorder=0)
    axes.plot(*zip(base, elbow, hand, strict=True), "o", color=INK, ms=4, zorder=0)


def draw_frames(path: Path) -> None:
    """The frames of a rig with two arms, seen along world y, and the gel as its camera shows it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    axes = new_axes(figure, 1, 2, "from the side: two sensors and a body")
    arm(axes, (-3.8, -3.0), (-3.0, -0.2), (-0.9, -0.9))
    arm(axes, (-3.8, 6.9), (-3.0, 4.6), (-0.9, 4.5))
    sensor(axes, 0, 0, 1)
    box(axes, 0, 1.8, 1.2, 3.6, BODY)
    axes.text(0, 1.8, "body", ha="center", va="center", fontsize=8.5, color=TEXT)
    sensor(axes, 0, 3.6, -1)
    frame(axes, (0, 0), "x", "z", "", signs=(1, 1))
    axes.text(1.4, 0.0, "world, and sensor lower\nwhere an episode starts", va="center", fontsize=8.5, color=TEXT)
    frame(axes, (0, 3.6), "x", "z", "", signs=(1, -1))
    axes.text(1.4, 3.6, "sensor upper:\nhalf a turn about x", va="center", fontsize=8.5, color=TEXT)
    frame(axes, (-3.8, -3.0), "x", "z", "base", signs=(1, 1))
    arrow = {"arrowstyle": "->", "color": INK, "ls": "--", "connectionstyle": "arc3,rad=0.25"}
    axes.annotate("", (-0.1, -0.05), (-3.6, -2.9), arrowprops=arrow)
    axes.text(-1.2, -2.45, "world_from_base", fontsize=8, color=INK)
    axes.text(1.4, -0.95, "flange_from_tool,\ntool_from_sensor", fontsize=8, color=INK, va="center")
    axes.text(6.2, -3.0, "y points into the page", ha="right", fontsize=8, color=AXES["y"])
    axes.set(xlim=(-5.2, 6.4), ylim=(-3.4, 7.2))

    axes = new_axes(figure, 2, 2, "the gel as its camera shows it")
    box(axes, 0, 0, 5.2, 3.9, GEL)
    frame(axes, (0, 0), "x", "y", "", signs=(1, -1))
    axes.text(
        -0.15, 0.3, "z out of the gel,\ntowards the object", ha="right", va="center", fontsize=8.5, color=AXES["z"]
    )
    axes.plot(0, 0, "o", color=AXES["z"], ms=9, mfc="none")
    axes.annotate(
        "u, columns", (0.6, 2.3), (-2.6, 2.3), arrowprops={"arrowstyle": "->", "color": INK}, va="center", fontsize=8.5
    )
    axes.annotate(
        "v, rows", (-2.95, -0.6), (-2.95, 1.9), arrowprops={"arrowstyle": "->", "color": INK}, ha="center", fontsize=8.5
    )
    axes.text(0, -2.35, "x = (u - u0) pixel_pitch,  y = (v - v0) pixel_pitch", ha="center", fontsize=8.5, color=TEXT)
    axes.set(xlim=(-3.6, 3.2), ylim=(-2.8, 2.8))
    save(figure, path)


def draw_setups(path: Path) -> None:
    """Two arms, one arm, a sensor on a stand."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    axes = new_axes(figure, 1, 3, "two arms: ur5e")
    arm(axes, (-3.2, -2.5), (-3.0, 0.4), (0, -1.3))
    arm(axes, (3.2, -2.5), (3.0, 4.2), (0, 3.3))
    sensor(axes, 0, 0, 1)
    box(axes, 0, 1.0, 1.2, 2.0, BODY)
    sensor(axes, 0, 2.0, -1)
    axes = new_axes(figure, 2, 3, "one arm: ur5e-one")
    arm(axes, (-3.2, -2.5), (-2.6, 3.6), (0.8, 1.6))
    sensor(axes, 0.8, 0.3, -1)
    axes.add_patch(Circle((0.8, -1.5), 1.0, facecolor=BODY, edgecolor=INK, lw=0.8))
    axes = new_axes(figure, 3, 3, "a sensor on a stand: stand")
    axes.plot([-0.7, -0.7, 0.7, 0.7], [-2.5, -1.1, -1.1, -2.5], color=GREY, lw=6, zorder=0)
    sensor(axes, 0, 0, 1)
    axes.plot([0, 0], [1.0, 3.0], color=GREY, lw=5, zorder=0)
    axes.add_patch(Circle((0, 0.9), 0.7, facecolor=BODY, edgecolor=INK, lw=0.8))
    axes.annotate("", (0.5, 1.9), (0.5, 3.0), arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.4})
    axes.text(0.75, 2.5, "pressed by hand", fontsize=8.5, color=TEXT)
    for each in figure.axes:
        each.plot([-4.2, 4.2], [-2.5, -2.5], color=INK, lw=1.2)
        each.set(xlim=(-4.4, 4.4), ylim=(-2.8, 5.0))
    save(figure, path)


def draw_mock(path: Path) -> None:
    """Your code, the sockets, the mock devices, and the simulator behind them."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 2.9), layout="constrained")
    axes = new_axes(figure, 1, 1, "")
    blocks = [
        (1.6, 2.0, 2.8, 3.2, BODY, "your code\n\npolicy, driver,\ncontroller, test"),
        (7.4, 3.1, 3.6, 1.4, GREY, "mock UR controller\na process, 500 Hz"),
        (7.4, 0.9, 3.6, 1.4, GREY, "mock camera\na process, MJPEG"),
        (12.8, 2.0, 2.8, 3.2, GEL, "simulator\n\ngels and body,\nor Hertz"),
    ]
    for x, y, width, height, colour, words in blocks:
        box(axes, x, y, width, height, colour)
        axes.text(x, y, words, ha="center", va="center", fontsize=9, color=TEXT)
    both, right, left = "<|-|>", "-|>", "<|-"
    arrows = [
        (3.0, 5.6, 3.1, both, "RTDE 30004, script,\ndashboard 29999"),
        (3.0, 5.6, 0.9, left, "HTTP 8081"),
        (9.2, 11.4, 3.35, right, "poses"),
        (9.2, 11.4, 2.85, left, "forces"),
        (9.2, 11.4, 0.9, left, "pictures"),
    ]
    for start, end, y, style, words in arrows:
        axes.annotate("", (end, y), (start, y), arrowprops={"arrowstyle": style, "color": INK, "lw": 1.4})
        below = words == "forces"
        at, side = (y - 0.1, "top") if below else (y + 0.1, "bottom")
        axes.text((start + end) / 2, at, words, va=side, ha="center", fontsize=8, color=TEXT)
    axes.annotate(
        "faults on request: port 30020, or methods of the mock",
        (7.4, -0.35),
        ha="center",
        fontsize=8.5,
        color="#c62828",
    )
    axes.annotate("", (7.4, 0.15), (7.4, -0.15), arrowprops={"arrowstyle": "-|>", "color": "#c62828", "lw": 1.4})
    axes.set(xlim=(0.0, 14.4), ylim=(-0.7, 4.2))
    save(figure, path)


def save(figure: Figure, path: Path) -> None:
    """Writes the same bytes for the same drawing."""
    with matplotlib.rc_context({"svg.hashsalt": path.name, "svg.fonttype": "path"}):
        figure.savefig(path, metadata={"Date": None}, facecolor="white")


def main() -> None:
    images = ROOT / "docs" / "images"
    draw_frames(images / "frames.svg")
    draw_setups(images / "setups.svg")
    draw_mock(images / "mock.svg")


if __name__ == "__main__":
    main()

"""The pictures of the guides, in docs/images: python -m tools.site.guides

tasks.jpg: the body before and after each shipped task. observation.jpg: what a policy gets of a sensor. report.jpg and
compare.jpg: pages that tacsim writes, as a browser shows them (Chromium must be installed). collect.jpg: some presses
of a collected set (needs the extra 'export').
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

from robot import open_rig
from robot.rig.recorded import RecordedSurfaces
from tacsim import Action, Pose
from tacsim.record.reader import read_episode
from tacsim.report.figure import new_figure
from tacsim.report.section import gel_states, section_of
from tools.site.gallery import save
from tools.site.pages import ROOT

TASKS = {
    "squeeze": "squeeze: to a given height",
    "reposition": "reposition: moved along the gels",
    "knead": "knead: squeezed and moved",
}
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
COMMAND = (sys.executable, "-c", "from robot.cli import main; main()")


def call(folder: Path, *words: str) -> None:
    """Runs a command of tacsim in a folder."""
    subprocess.run([*COMMAND, *words], cwd=folder, check=True, stdout=subprocess.DEVNULL)


def draw_tasks(path: Path, folder: Path) -> None:
    """A section through body and gels at the beginning and at the best step of each shipped task. Its episode is in the
    folder of its name."""
    figure = new_figure(3.2 * len(TASKS), 4.6)
    figure.set_layout_engine("constrained")
    for column, (task, title) in enumerate(TASKS.items()):
        episode = read_episode(folder / task / "episode.mcap")
        surfaces = RecordedSurfaces(episode.meta)
        section = section_of(episode, surfaces.gels, (560, 420))
        assert section is not None
        distances = [np.inf if step.distance is None else step.distance for step in episode.steps]
        best = int(np.argmin(distances))
        for row, at in enumerate((0, best)):
            step = episode.steps[at]
            axes = figure.add_subplot(2, len(TASKS), row * len(TASKS) + column + 1)
            axes.imshow(section.draw(step.body, gel_states(step, surfaces.gels, surfaces)))
            axes.set(xticks=[], yticks=[])
            axes.set_title(title if row == 0 else f"{1e3 * distances[at]:.2f} mm from the goal", fontsize=9)
            if column == 0:
                axes.set_ylabel("at the beginning" if row == 0 else "at the end", fontsize=9)
    save(figure, path)


def draw_observation(path: Path) -> None:
    """The fields of one sensor under a ball that is pressed and pulled sideways."""
    down, sideways = np.array([0.0, 0.0, 0.2e-3]), np.array([0.25e-3, 0.0, 0.0])
    with open_rig("press", overrides=["scene.preset=standard"]) as rig:
        observation = rig.reset()
        for motion in [down] * 4 + [sideways] * 3:
            pose = observation.arms["lower"].pose
            observation, _ = rig.step(Action({"lower": Pose(pose.position + motion, pose.quaternion)}))
    touch: Any = observation.tactile["lower"]
    shown = {
        "picture": touch.picture,
        "image": touch.image,
        "height [mm]": 1e3 * touch.height,
        "gradient along x": touch.gradient[..., 0],
        "contact": touch.contact,
    }
    figure = new_figure(12.0, 3.0)
    figure.set_layout_engine("constrained")
    for place, (title, values) in enumerate(shown.items(), start=1):
        axes = figure.add_subplot(1, len(shown) + 1, place)
        drawn = axes.imshow(values, cmap="gray" if title == "contact" else "viridis")
        if values.ndim == 2 and title != "contact":
            figure.colorbar(drawn, ax=axes, location="bottom", shrink=0.8).ax.tick_params(labelsize=7)
        axes.set(xticks=[], yticks=[])
        axes.set_title(title, fontsize=9)
    axes = figure.add_subplot(1, len(shown) + 1, len(shown) + 1)
    rows, columns = touch.flow.shape[:2]
    axes.quiver(*np.meshgrid(np.arange(columns), np.arange(rows)), touch.flow[..., 0], touch.flow[..., 1], angles="xy")
    axes.set(xticks=[], yticks=[], aspect="equal")
    axes.invert_yaxis()
    axes.set_title("flow", fontsize=9)
    save(figure, path)


def draw_presses(path: Path, folder: Path) -> None:
    """The first presses of the set in `folder`."""
    from pyarrow import parquet

    columns, rows = 6, 2
    found = [each for file in sorted(folder.rglob("*.parquet")) for each in parquet.read_table(file).to_pylist()]
    figure = new_figure(1.9 * columns, 1.7 * rows)
    figure.set_layout_engine("constrained")
    for place, press in enumerate(found[: columns * rows], start=1):
        axes = figure.add_subplot(rows, columns, place)
        axes.imshow(Image.open(BytesIO(press["image"]["bytes"])))
        axes.set(xticks=[], yticks=[])
    save(figure, path)


def draw_page(page: Path, path: Path, size: tuple[int, int], width: int) -> None:
    """A page as a browser of this size shows it [px], `width` wide."""
    program = next((found for name in BROWSERS if (found := shutil.which(name)) is not None), None)
    if program is None:
        raise SystemExit(f"{path.name} needs a browser: none of {', '.join(BROWSERS)} is installed")
    with TemporaryDirectory() as profile:
        taken = Path(profile) / "page.png"
        options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--user-data-dir={profile}"]
        window = f"--window-size={size[0]},{size[1] + 100}"  # of the window; some rows of it are no page
        address = page.resolve().as_uri()
        waiting = "--virtual-time-budget=3000"
        subprocess.run(
            [program, *options, window, waiting, f"--screenshot={taken}", address], check=True, capture_output=True
        )
        picture = Image.open(taken).convert("RGB").crop((0, 0, *size))
    smaller = picture.resize((width, round(width * size[1] / size[0])), Image.Resampling.LANCZOS)
    smaller.save(path, quality=88, optimize=True)


def main() -> None:
    images = ROOT / "docs" / "images"
    with TemporaryDirectory() as made:
        folder = Path(made)
        for task in TASKS:
            call(folder, "run", "--task", task, "--out", task)
        draw_tasks(images / "tasks.jpg", folder)
        draw_page(folder / "squeeze" / "report.html", images / "report.jpg", (1280, 860), 900)
        call(folder, "collect", "samples", "--out", "samples")
        call(folder, "compare", "samples/simulation", "samples/sensor", "--out", "compared")
        draw_page(folder / "compared" / "compare.html", images / "compare.jpg", (1280, 1480), 900)
        call(folder, "collect", "press", "--count", "12", "--preset", "standard", "--sensor", "gelsight-mini",
             "--depth", "0.5..1.0mm", "--out", "set")  # fmt: skip
        draw_presses(images / "collect.jpg", folder / "set")
    draw_observation(images / "observation.jpg")


if __name__ == "__main__":
    main()

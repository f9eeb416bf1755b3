"""Learning curves of trainings from the reward: `python -m benchmarks.reinforce_picture OUT.png RUN [RUN ...]`.

A RUN is the folder of a `tacsim train TASK --algorithm ppo|sac`. Each is a line of success in its own episodes, whose
actions have a random part. A file `RUN.eval.json`, written by `tacsim evaluate --json`, adds a dot with its interval.
"""

from __future__ import annotations

import json
from itertools import accumulate
from pathlib import Path
from typing import Annotated

import typer

from robot.train.evaluate import Interval, wilson_interval

COLOURS = {"ppo": "#2b6cb0", "sac": "#c05621"}


def main(out: Path, runs: Annotated[list[Path], typer.Argument()]) -> None:
    """Writes a picture with one panel for each task."""
    from matplotlib.figure import Figure

    settings = {run: json.loads((run / "run.json").read_text(encoding="utf-8"))["training"] for run in runs}
    tasks = sorted({each["task"] for each in settings.values()})
    figure = Figure(figsize=(5.5 * len(tasks), 3.6), layout="constrained")
    panels = dict(zip(tasks, figure.subplots(1, len(tasks), squeeze=False)[0], strict=True))
    for run, training in settings.items():
        panel, algorithm, seed = panels[training["task"]], training["algorithm"], training["seed"]
        rounds = json.loads((run / "curve.json").read_text(encoding="utf-8"))
        steps = [total / 1e3 for total in accumulate(each["steps"] for each in rounds)]
        style, colour = ["-", "--", ":"][seed % 3], COLOURS[algorithm]
        panel.plot(steps, [100 * each["success"] for each in rounds], style, color=colour, alpha=0.7)
        panel.plot([], [], style, marker="o", color=colour, label=f"{algorithm.upper()}, seed {seed}")
        if (found := run.with_name(f"{run.name}.eval.json")).exists():
            success = success_of(found)
            low, high = success.value - success.low, success.high - success.value
            panel.errorbar(
                steps[-1], 100 * success.value, [[100 * low], [100 * high]], fmt="o", color=colour, capsize=3
            )
    for task, panel in panels.items():
        panel.axhline(90, color="#2f855a", linestyle="--", linewidth=0.8)
        panel.set(title=task, xlabel="control steps (thousands)", ylabel="success [%]", ylim=(0, 101))
        panel.grid(alpha=0.3)
        panel.legend(loc="lower right")
    figure.savefig(out, dpi=110)


def success_of(evaluation: Path) -> Interval:
    """Success rate of the only policy of an evaluation, with Wilson's 95 % interval."""
    (episodes,) = json.loads(evaluation.read_text(encoding="utf-8")).values()
    return wilson_interval(sum(bool(each["success"]) for each in episodes), len(episodes))


if __name__ == "__main__":
    typer.run(main)

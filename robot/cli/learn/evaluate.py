"""`tacsim evaluate`: how good policies are, in the same unseen episodes."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robot.cli.options import Overrides
from robot.cli.output import notes, one_bar, require_writable, show_table, warn

if TYPE_CHECKING:
    from robot.train.evaluate import Interval, Judged


def evaluate(
    task: Annotated[str, typer.Argument(help="squeeze, reposition, knead, or the path of a training file.")],
    policy: Annotated[
        list[str] | None,
        typer.Option(
            help="teacher (by the truth), random, scripted, learned (the shipped one), FILE.onnx; may be repeated.",
            show_default="teacher, scripted, random",
        ),
    ] = None,
    episodes: Annotated[int, typer.Option(min=2, max=10_000, help="Of each policy.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same episodes.")] = 0,
    json_: Annotated[
        Path | None, typer.Option("--json", help="Write how each episode ended, while it goes on.", show_default=False)
    ] = None,
    set_: Overrides = None,
) -> None:
    """Compare policies in the same episodes, whose bodies and goals no training has met.

    Success with Wilson's interval, distance and improvement (share of the distance at the start) with a bootstrap's,
    all of 95 %; the peak of the normal force as mean and as what one episode in twenty exceeds; the share of episodes
    in which a learned policy observed what it did not observe in its training.

    Example: tacsim evaluate squeeze --policy learned --policy scripted --episodes 50
    """
    require_writable(json_, "--json", new=True)
    from robot.train.evaluate import evaluate as judge_all
    from tacsim.config import load
    from tacsim.models.training import Training

    training = load(Training, task, set_ or [])
    played: dict[str, Judged] = {}
    with one_bar("starting") as bar:

        def tell(words: str, done: int, of: int) -> None:
            bar.say(words)
            bar.count(done, of)

        def say(so_far: Judged) -> None:
            played[so_far.policy] = so_far
            if json_ is not None:
                _write(json_, played.values())
            done, success = len(so_far.episodes), interval_text(so_far.success, 100, 0)
            notes.print(f"{so_far.policy}: {done} of {episodes} episodes, success {success} %", markup=False)

        judged = judge_all(training, policy or ["teacher", "scripted", "random"], episodes, seed, tell, say, warn)
    _show(judged)


def _write(path: Path, judged: Iterable[Judged]) -> None:
    import json

    from robot.common.whole_file import write_whole

    ends = {each.policy: [end._asdict() for end in each.episodes] for each in judged}
    write_whole(path, (json.dumps(ends, indent=1) + "\n").encode())


def _show(judged: list[Judged]) -> None:
    names, rows = [Path(each.policy).name for each in judged], []
    if len(set(names)) < len(names):
        names = [each.policy for each in judged]
    for name, each in zip(names, judged, strict=True):
        mean, most = each.peak_force
        rows.append(
            (
                name,
                interval_text(each.success, 100, 0),
                interval_text(each.distance, 1e3, 3),
                interval_text(each.improvement, 100, 0),
                f"{mean:.1f}, {most:.1f}",
                "–" if each.outside is None else f"{100 * each.outside:.0f}",
            )
        )
    columns = ("policy", "success [%]", "distance [mm]", "improvement [%]", "peak force [N]", "outside training [%]")
    show_table(f"{len(judged[0].episodes)} unseen episodes, 95 % intervals", columns, rows, left={0})


def interval_text(interval: Interval, scale: float, digits: int) -> str:
    value, low, high = (f"{scale * number:.{digits}f}" for number in (interval.value, interval.low, interval.high))
    return f"{value} ({low} to {high})"

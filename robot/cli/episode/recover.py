"""`tacsim recover`: a finished MCAP file of a recording that was cut off."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from robot.cli.output import busy, results, say_files


def recover(
    file: Annotated[Path, typer.Argument(help="A recording that was cut off or damaged; it is only read.")],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The new file.", show_default="FILE.recovered.mcap beside it")
    ] = None,
) -> None:
    """Make a finished MCAP file of a recording that was cut off (killed, power, full disk) or damaged.

    tacsim reads recordings that were cut off as they are; other tools (Foxglove, mcap) need the end of the file with
    its index. Every whole step is kept; what is lost is said.

    Example: tacsim recover runs/first/episode.mcap
    """
    new = file.with_name(f"{file.stem}.recovered.mcap") if out is None else out
    with busy("recovering"):
        from tacsim.record.recover import recover as recover_file

        found = recover_file(file, new)
    if found.whole:
        results.print(f"{file} is whole: {found.steps} steps, its end and its index; nothing to recover", markup=False)
        return
    lost = [] if found.finished else ["the end: the recording was cut off, or its index is damaged"]
    lost += [f"bytes {begin} to {end}: a step that was not finished, or is damaged" for begin, end in found.damaged]
    results.print(f"{found.steps} steps recovered; without:", markup=False)
    for words in [
        *lost[:20],
        *([f"... and {len(lost) - 20} more parts"] if len(lost) > 20 else []),
        *found.lacking[:20],
    ]:
        results.print(f"  {words}", markup=False)
    say_files(new)

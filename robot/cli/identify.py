"""`tacsim identify …`: the material of a gel or a body, from recorded presses or squeezes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from robot.cli.options import (
    OptionGroup,
    Out,
    Overrides,
    complete_names,
    length_option,
    quantities_parser,
    quantity_parser,
    with_option_groups,
)
from robot.cli.output import (
    busy,
    new_directory,
    notes,
    one_bar,
    print_files,
    print_json,
    results,
    show_table,
    warn,
    writing,
)
from robot.cli.terminal import EXIT_USAGE, print_error

if TYPE_CHECKING:
    from calibration.materials.fit import Noise
    from robot.studies.identify.identify import Identified, Kind
    from tacsim.interface import Pose
    from tacsim.models.scene import Scene


identify = typer.Typer(no_args_is_help=True, help="Identify the material of a gel or a body from recorded presses.")

Recorded = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Episodes (.mcap), tables (.csv: x, y, z, fx, fy, fz), or folders of them.", show_default=False
    ),
]
Balls = Annotated[
    list[str] | None,
    typer.Option(
        "--ball", metavar="NAME=RADIUS", show_default="the scene's", help="The ball of one recording; may be repeated."
    ),
]
FORCE_PARSER = quantity_parser("force", 1e-6, 1e3)


class Fitting(OptionGroup):
    """The options of both commands."""

    fit: Annotated[str | None, typer.Option(metavar="NAMES", help="Only these parameters, separated by commas.")] = None
    force_noise: Annotated[
        Any,
        typer.Option(
            parser=FORCE_PARSER, metavar="FORCE", help="Standard deviation of a reading of force.",
            show_default="1 N recorded by a UR's own, else 0.02 N",
        ),
    ] = None  # fmt: skip
    zero_error: Annotated[
        Any,
        typer.Option(
            parser=FORCE_PARSER, metavar="FORCE", help="Error of the zero of the force.",
            show_default="ten times the noise",
        ),
    ] = None  # fmt: skip
    place_error: Annotated[Any, length_option("Error of the contact's position along the press.", 1e-9, 1e-2)] = (
        "0.02 mm"
    )
    preset: Annotated[Literal["learn", "draft", "standard"], typer.Option(help="Resolution of the finest mesh.")] = (
        "standard"
    )
    moments: Annotated[int, typer.Option(min=4, max=1000, help="Number of simulated moments of a press.")] = 16
    motions: Annotated[
        Path | None,
        typer.Option(
            help="Only write motions that identify all parameters, for `tacsim run RIG --policy FILE.csv`, here."
        ),
    ] = None
    set_: Overrides = None
    out: Out = None


@with_option_groups
def gel(
    presses: Recorded = None,
    scene: Annotated[
        str, typer.Option(help="The scene that was pressed, with an indenter.", autocompletion=complete_names("scene"))
    ] = "press",
    indenter: Annotated[
        Any,
        typer.Option(
            parser=quantities_parser("length", 3), metavar="X,Y,Z",
            help="Position of the indenter's centre in the rig's world.", show_default="as in the scene",
        ),
    ] = None,
    ball: Balls = None,
    *,
    options: Fitting,
) -> None:  # fmt: skip
    """A gel's stiffness, Poisson's ratio and friction: material.yaml, scene.yaml, identified.json, identified.png.

    The presses are simulated until forces (and heights and flow, if recorded) agree. The command names parameters that
    they do not identify, with a motion that would identify them. A table's z is the height of the indenter's lowest
    point above the gel.

    Example: tacsim identify gel runs/presses --force-noise '10 mN' --out runs/my-gel
    """
    where = None
    if indenter is not None:
        import numpy as np

        from tacsim.interface import Pose

        where = Pose(np.array(indenter))
    _IdentifyCommand("gel", scene, options).run(presses or [], where, _parse_balls(ball or []))


@with_option_groups
def body(
    squeezes: Recorded = None,
    scene: Annotated[
        str, typer.Option(help="The scene that was squeezed, with a body.", autocompletion=complete_names("scene"))
    ] = "squeeze",
    gel_error: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Relative standard deviation of the gels' stiffness.")
    ] = 0.0,
    *,
    options: Fitting,
) -> None:
    """A body's stiffness, yield stress, hardening and friction to each gel: the same files as for a gel.

    Each recording begins with a fresh body of the scene's shape; name the gel's material by --set gel.material=FILE. A
    table's z is the gap between the two gels.

    Example: tacsim identify body runs/squeezes --set gel.material=runs/my-gel/material.yaml --out runs/my-clay
    """
    _IdentifyCommand("body", scene, options, gel_error).run(squeezes or [])


def _parse_balls(given: list[str]) -> dict[str, float]:
    """Radius of the ball [m] by the name of its recording."""
    found, radius = {}, quantity_parser("length", 1e-4, 0.1)
    for text in given:
        name, equals, value = text.rpartition("=")
        if not equals or not name:
            raise typer.BadParameter(f"'{text}' is not NAME=RADIUS, such as press-2='6 mm'", param_hint="--ball")
        found[name] = radius(value)
    return found


class _IdentifyCommand:
    """The work of both commands."""

    def __init__(self, kind: Kind, scene: str, options: Fitting, gel_error: float = 0.0) -> None:
        from tacsim.config import load_scene
        from tacsim.config.load import describe_scene_meshes

        self.kind, self.options, self.gel_error = kind, options, gel_error
        self.wanted = [] if options.fit is None else [name.strip() for name in options.fit.split(",")]
        self.scene: Scene = load_scene(scene, [f"preset={options.preset}", *(options.set_ or [])])
        needs, has = ("an indenter", self.scene.indenter) if kind == "gel" else ("a body", self.scene.body)
        if has is None:
            raise typer.BadParameter(f"scene '{self.scene.name}' has not {needs}", param_hint="--scene")
        if self.scene.physics == "seed":
            raise typer.BadParameter("physics 'seed' cannot be identified; use 'hybrid'", param_hint="--set")
        for words in describe_scene_meshes(self.scene):
            notes.print(words)

    def run(self, sources: list[Path], indenter: Pose | None = None, balls: Mapping[str, float] | None = None) -> None:
        ur_noise, other_noise = 1.0, 0.02  # [N]
        options = self.options
        if options.motions is not None:
            self._write_motions(options.motions)
            return
        if not sources:
            raise typer.BadParameter(
                "name recordings, or --motions FOLDER for what to record", param_hint="PRESSES or SQUEEZES"
            )
        folder = new_directory(options.out, f"identify-{self.kind}")
        with busy("loading"):
            from calibration.materials.fit import Noise, Priors
            from robot.studies.identify.identify import identify
            from robot.studies.identify.recordings import Recordings, find_recordings, read_all
            from tacsim.physics.failure.dump import dump_to_folder
        with one_bar("reading") as bar:
            recordings = Recordings(self.scene, indenter, balls)
            presses = read_all(recordings, find_recordings(sources), bar.set_progress)
            force = options.force_noise
            if force is None:
                force = ur_noise if recordings.from_ur else other_noise
                notes.print(f"force noise taken as {force:g} N; give your sensor's by --force-noise")
            noise = Noise(force=force)
            zero = 10 * force if options.zero_error is None else options.zero_error
            with dump_to_folder(folder.with_name(f"{folder.name}-diverged")):
                found = identify(
                    self.kind, self.scene, recordings, presses, noise, Priors(options.place_error, zero),
                    wanted=self.wanted, max_moments=options.moments, gel_error=self.gel_error,
                    on_step=bar.set_text, on_run=bar.set_progress,
                )  # fmt: skip
        self._report_results(found, folder, noise)

    def _report_results(self, found: Identified, folder: Path, noise: Noise) -> None:
        force_noises = (1.0, 0.1, 0.01)  # of force sensors for which the intervals are predicted [N]
        # relative, of an indenter: a calliper is more accurate than a larger standard deviation
        max_size_deviation = 0.1
        from robot.studies.identify.identify import predict_intervals
        from robot.studies.identify.motions import MOTION_TEXTS, MOTIONS_FOR_PARAMETER
        from robot.studies.identify.results import as_json, describe_parameters, write

        with busy("drawing"), writing(folder.parent):
            files = write(folder, found)
        title = f"{self.kind.capitalize()}, {len(found.presses)} recordings, {found.fit.runs} simulated"
        show_table(title, ("", "value", "95 %"), describe_parameters(found), left={0})
        looks = {sensor: predict_intervals(found, sensor) for sensor in dict.fromkeys((noise.force, *force_noises))}
        rows = [
            (each.name, *(_half_interval_text(look[each.name]) for look in looks.values()))
            for each in found.fit.identified
        ]
        show_table("With another force sensor, 95 %", ("noise", *(f"{one:g} N" for one in looks)), rows, left={0})
        for each in found.fit.unidentified:
            motion = MOTIONS_FOR_PARAMETER[self.kind][each.name]
            warn(
                f"{each.name} is not identified by these recordings and keeps its value; '{motion}' would identify it: "
                f"{MOTION_TEXTS[motion]} (tacsim identify {self.kind} --motions FOLDER writes it)"
            )
        if found.size_error is not None and found.size_error > max_size_deviation:
            warn(
                f"interval of the indenter's size from the recordings: {_half_interval_text(2 * found.size_error)}; a "
                "wrong size would not be detected: measure it, or record heights (a calibrated sensor)"
            )
        print_files(*files)
        print_json(as_json(found), files)
        for finding in found.findings:
            print_error(finding.text)
        if found.findings:
            print_error(f"no material is written: {folder / 'identified.png'} shows why")
            raise typer.Exit(EXIT_USAGE)
        if self.wanted and (missing := [each.name for each in found.fit.unidentified]):
            print_error(f"requested and not identified: {', '.join(missing)}")
            raise typer.Exit(EXIT_USAGE)

    def _write_motions(self, folder: Path) -> None:
        from robot.studies.identify.motions import motions

        new_directory(folder, "motions")
        rig = "press" if self.kind == "gel" else "sim"
        commands: list[str] = []
        with writing(folder, new=True):
            for name, table in motions(self.scene).items():
                path = folder / f"{name}.csv"
                path.write_text(table, encoding="utf-8")
                steps = len(table.splitlines()) - 1
                commands.append(f"tacsim run {rig} --policy {path} --steps {steps} --out runs/{name}")
                results.print(commands[-1])
        print_json({"commands": commands}, sorted(folder.iterdir()))


def _half_interval_text(half: float) -> str:
    """Text of half an interval of a free parameter."""
    from calibration.materials.tuning import MAX_IDENTIFIED_HALF_INTERVAL

    return f"± {100 * half:.2g} %" if half < MAX_IDENTIFIED_HALF_INTERVAL else "nothing"

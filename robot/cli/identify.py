"""`tacsim identify …`: what a gel or a body is made of, from recorded presses or squeezes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from robot.cli.errors import UNUSABLE, complain
from robot.cli.options import OptionGroup, Out, Overrides, grouped, length, quantities, quantity
from robot.cli.output import busy, new_directory, notes, one_bar, results, say_files, show_table, warn, writing

if TYPE_CHECKING:
    from calibration.materials.presses import Noise
    from robot.studies.identify.identify import Identified, Kind
    from tacsim.interface import Pose
    from tacsim.models.scene import Scene


identify = typer.Typer(no_args_is_help=True, help="What a gel or a body is made of, from recorded presses.")

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
FORCE = quantity("force", 1e-6, 1e3)


class Fitting(OptionGroup):
    """The options that both commands have."""

    fit: Annotated[str | None, typer.Option(metavar="NAMES", help="Only these, with commas between.")] = None
    force_noise: Annotated[
        Any,
        typer.Option(
            parser=FORCE, metavar="FORCE", help="Standard deviation of a reading of force.",
            show_default="1 N recorded by a UR's own, else 0.02 N",
        ),
    ] = None  # fmt: skip
    zero_error: Annotated[
        Any,
        typer.Option(
            parser=FORCE, metavar="FORCE", help="How far the zero of the force may be off.",
            show_default="ten times the noise",
        ),
    ] = None  # fmt: skip
    place_error: Annotated[Any, length("How far the place of the contact may be off along the press.", 1e-9, 1e-2)] = (
        "0.02 mm"
    )
    preset: Annotated[Literal["learn", "draft", "standard"], typer.Option(help="Resolution of the finest mesh.")] = (
        "standard"
    )
    moments: Annotated[int, typer.Option(min=4, max=1000, help="Of a press, that are simulated.")] = 16
    motions: Annotated[
        Path | None,
        typer.Option(
            help="Only write motions that tell all, for `tacsim run RIG --policy FILE.csv`, into this new folder."
        ),
    ] = None
    set_: Overrides = None
    out: Out = None


@grouped
def gel(
    presses: Recorded = None,
    scene: Annotated[str, typer.Option(help="What was pressed: a scene with an indenter.")] = "press",
    indenter: Annotated[
        Any,
        typer.Option(
            parser=quantities("length", 3), metavar="X,Y,Z",
            help="Where the centre of the indenter lies in the rig's world.", show_default="where the scene puts it",
        ),
    ] = None,
    ball: Balls = None,
    *,
    options: Fitting,
) -> None:  # fmt: skip
    """A gel's stiffness, Poisson's ratio and friction: material.yaml, scene.yaml, identified.json, identified.png.

    The presses are simulated again until forces (and heights and flow, where recorded) agree. What they do not tell is
    named, with the motion that would tell it. A table's z is the height of the indenter's lowest point above the gel.

    Example: tacsim identify gel runs/presses --force-noise '10 mN' --out runs/my-gel
    """
    where = None
    if indenter is not None:
        import numpy as np

        from tacsim.interface import Pose

        where = Pose(np.array(indenter))
    _Task("gel", scene, options).run(presses or [], where, _balls(ball or []))


@grouped
def body(
    squeezes: Recorded = None,
    scene: Annotated[str, typer.Option(help="What was squeezed: a scene with a body.")] = "squeeze",
    gel_error: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Standard deviation of the gels' stiffness, as a share of it.")
    ] = 0.0,
    *,
    options: Fitting,
) -> None:
    """A body's stiffness, yield, hardening and friction to each gel: the same files as of a gel.

    Each recording begins with a fresh body of the scene's shape; name the gel's material by --set gel.material=FILE. A
    table's z is the gap between the two gels.

    Example: tacsim identify body runs/squeezes --set gel.material=runs/my-gel/material.yaml --out runs/my-clay
    """
    _Task("body", scene, options, gel_error).run(squeezes or [])


def _balls(given: list[str]) -> dict[str, float]:
    """Radius of the ball [m] by the name of its recording."""
    found, radius = {}, quantity("length", 1e-4, 0.1)
    for text in given:
        name, equals, value = text.rpartition("=")
        if not equals or not name:
            raise typer.BadParameter(f"'{text}' is no NAME=RADIUS, such as press-2='6 mm'", param_hint="--ball")
        found[name] = radius(value)
    return found


class _Task:
    """What both commands do."""

    def __init__(self, kind: Kind, scene: str, options: Fitting, gel_error: float = 0.0) -> None:
        from tacsim.config import load_scene
        from tacsim.config.load import say_side

        self.kind, self.options, self.gel_error = kind, options, gel_error
        self.wanted = [] if options.fit is None else [name.strip() for name in options.fit.split(",")]
        self.scene: Scene = load_scene(scene, [f"preset={options.preset}", *(options.set_ or [])])
        needs, has = ("an indenter", self.scene.indenter) if kind == "gel" else ("a body", self.scene.body)
        if has is None:
            raise typer.BadParameter(f"scene '{self.scene.name}' has not {needs}", param_hint="--scene")
        if self.scene.physics == "seed":
            raise typer.BadParameter("physics 'seed' cannot be identified; use 'hybrid'", param_hint="--set")
        for words in say_side(self.scene):
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
            from calibration.materials.fit import Priors
            from calibration.materials.presses import Noise
            from robot.studies.identify.identify import identify
            from robot.studies.identify.recordings import Recordings, find_recordings, read_all
            from tacsim.physics.failure.dump import dumps_in
        with one_bar("reading") as bar:
            recordings = Recordings(self.scene, indenter, balls)
            presses = read_all(recordings, find_recordings(sources), bar.count)
            force = options.force_noise
            if force is None:
                force = ur_noise if recordings.from_ur else other_noise
                notes.print(f"force noise taken as {force:g} N; give your sensor's by --force-noise")
            noise = Noise(force=force)
            zero = 10 * force if options.zero_error is None else options.zero_error
            with dumps_in(folder.with_name(f"{folder.name}-diverged")):
                found = identify(
                    self.kind, self.scene, recordings, presses, noise, Priors(options.place_error, zero),
                    wanted=self.wanted, max_moments=options.moments, gel_error=self.gel_error,
                    on_step=bar.say, on_run=bar.count,
                )  # fmt: skip
        self._tell(found, folder, noise)

    def _tell(self, found: Identified, folder: Path, noise: Noise) -> None:
        force_noises = (1.0, 0.1, 0.01)  # force sensors that the result is looked at with [N]
        # of an indenter, as a share: a standard deviation beyond tells nothing that a calliper does not
        max_size_deviation = 0.1
        from robot.studies.identify.identify import predict_intervals
        from robot.studies.identify.motions import MOTION_TEXTS, MOTIONS_FOR_PARAMETER
        from robot.studies.identify.results import describe_parameters, write

        with busy("drawing"), writing(folder.parent):
            files = write(folder, found)
        title = f"{self.kind.capitalize()}, {len(found.presses)} recordings, {found.fit.runs} simulated"
        show_table(title, ("", "value", "95 %"), describe_parameters(found), left={0})
        looks = {sensor: predict_intervals(found, sensor) for sensor in dict.fromkeys((noise.force, *force_noises))}
        rows = [(each.name, *(_reach(look[each.name]) for look in looks.values())) for each in found.fit.identified]
        show_table("With another force sensor, 95 %", ("noise", *(f"{one:g} N" for one in looks)), rows, left={0})
        for each in found.fit.unidentified:
            motion = MOTIONS_FOR_PARAMETER[self.kind][each.name]
            warn(
                f"{each.name} is not told by these recordings and stays as it was; '{motion}' would tell it: "
                f"{MOTION_TEXTS[motion]} (tacsim identify {self.kind} --motions FOLDER writes it)"
            )
        if found.size_error is not None and found.size_error > max_size_deviation:
            warn(
                f"these recordings tell of the size of the indenter {_reach(2 * found.size_error)}: a wrong one would "
                "not be noticed; measure it, or record heights (a calibrated sensor)"
            )
        say_files(*files)
        for finding in found.findings:
            complain(finding.text)
        if found.findings:
            complain(f"no material is written: {folder / 'identified.png'} shows why")
            raise typer.Exit(UNUSABLE)
        if self.wanted and (missing := [each.name for each in found.fit.unidentified]):
            complain(f"asked for and not told: {', '.join(missing)}")
            raise typer.Exit(UNUSABLE)

    def _write_motions(self, folder: Path) -> None:
        from robot.studies.identify.motions import motions

        new_directory(folder, "motions")
        rig = "press" if self.kind == "gel" else "sim"
        with writing(folder, new=True):
            for name, table in motions(self.scene).items():
                path = folder / f"{name}.csv"
                path.write_text(table, encoding="utf-8")
                steps = len(table.splitlines()) - 1
                results.print(f"tacsim run {rig} --policy {path} --steps {steps} --out runs/{name}")


def _reach(half: float) -> str:
    """Half an interval of a free number, in words."""
    from calibration.materials.tuning import MAX_IDENTIFIED_HALF_INTERVAL

    return f"± {100 * half:.2g} %" if half < MAX_IDENTIFIED_HALF_INTERVAL else "nothing"

"""`tacsim press`, `reproduce` and `debug`: simulations without a policy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from robot.cli.options import (
    OptionGroup,
    Out,
    Overrides,
    Preset,
    SensorModel,
    angle_option,
    complete_names,
    length_option,
    quantities_parser,
    with_option_groups,
)
from robot.cli.output import (
    busy,
    new_directory,
    notes,
    print_files,
    print_json,
    progress,
    report_mesh_measuring,
    results,
    writing,
)
from robot.cli.terminal import EXIT_FAILED, Interrupt, print_error
from tacsim.models.text import suggest_word

if TYPE_CHECKING:
    from tacsim.models.scene import Scene
    from tacsim.models.sensor import SensorModel as Sensor
    from tacsim.report.figure4 import Trial

AXES = ("roll", "pitch", "yaw")


class IndenterShape(OptionGroup):
    """Options that describe the indenter and its orientation."""

    radius: Annotated[Any, length_option("Of a sphere or cylinder; 4 mm by default.")] = None
    height: Annotated[Any, length_option("Of a cylinder; 5 mm by default.")] = None
    size: Annotated[
        Any,
        typer.Option(parser=quantities_parser("length", 3), metavar="X,Y,Z", help="Of a box; 5, 5, 5 mm by default."),
    ] = None
    edge_radius: Annotated[Any, length_option("Of a box's or cylinder's edges; half an element by default.")] = None
    scale: Annotated[
        float | None,
        typer.Option(help="Metres per unit of the mesh file; guessed from its size by default.", show_default=False),
    ] = None
    repair: Annotated[bool, typer.Option("--repair", help="Close holes of the mesh and turn triangles round.")] = False
    down: Annotated[
        Literal["-z", "+z", "-x", "+x", "-y", "+y"] | None,
        typer.Option(help="Side of the indenter, in its own axes, that presses; -z by default.", show_default=False),
    ] = None
    rotation: Annotated[
        Any,
        typer.Option(
            parser=quantities_parser("angle", 3),
            metavar="ROLL,PITCH,YAW",
            help="Rotate it about the world's x, then y, then z, instead of --down.",
        ),
    ] = None


@with_option_groups
def press(
    indenter: Annotated[
        str,
        typer.Argument(
            help="sphere, cylinder, box, or the path of an STL, OBJ or PLY file.",
            autocompletion=complete_names(words=("sphere", "cylinder", "box")),
        ),
    ],
    *,
    depth: Annotated[Any, length_option("Depth below the surface of the untouched gel.")] = "0.5 mm",
    slide: Annotated[
        Any, typer.Option(parser=quantities_parser("length", 2), metavar="X,Y", help="Then slide by this distance.")
    ] = "0,0",
    twist: Annotated[Any, angle_option("Then rotate about the vertical.")] = "0",
    shape: IndenterShape,
    preset: Preset = "standard",
    sensor: SensorModel = "ideal",
    set_: Overrides = None,
    out: Out = None,
) -> None:  # fmt: skip
    """Press a rigid indenter on one gel: press.html, a page with picture, height in 3-D and force over depth.

    Also rgb.png, height.npy, height.png, press.json with force and contact radius, and side.png, which shows the side
    that presses.

    --set changes the scene, for example --set indenter.friction=0.3 (see tacsim schema scene).

    A calibrated sensor defines gel size, image and light; rgb.png is its metric image.

    Example: tacsim press sphere --radius '3 mm' --depth '0.4 mm' --slide '1 mm, 0'
    """
    folder = new_directory(out, "press")
    scene, model = _scene_of_press(indenter, shape, preset, sensor, set_ or [])
    with busy("pressing (the first run compiles the kernels, up to half a minute)") as say:
        from robot.studies import press as presses
        from tacsim.physics.failure.dump import dump_to_folder
        from tacsim.physics.failure.health import SimulationDiverged

        motion = presses.PressMotion(depth, slide, twist)
        with dump_to_folder(folder / "diverged"), report_mesh_measuring(say, "pressing"):
            try:
                pressed = presses.press(scene, model, motion)
            except SimulationDiverged as failure:
                say("it failed; searching for a possible depth")
                if (possible := presses.deepest_possible(scene, motion, failure)) is not None:
                    failure.possible = (
                        f"a depth of {motion.depth * 1e3:g} mm is not possible with this indenter; "
                        f"{possible * 1e3:g} mm is possible, as tested: --depth '{possible * 1e3:g} mm'"
                    )
                raise
        curve = presses.force_curve(scene, motion)
    config = presses.press_report(scene, motion, pressed, model)
    with writing(folder, new=True):
        presses.write(folder, pressed, config, scene, model, curve)
    _print_press(config, presses.MAX_MISSED_DEPTH_SHARE)
    written = sorted(folder.iterdir())
    print_files(*written)
    print_json({**config, "force_curve": curve}, written)


def _scene_of_press(
    indenter: str, shape: IndenterShape, preset: str, sensor: str, overrides: list[str]
) -> tuple[Scene, Sensor]:
    """The scene of a press and the sensor that feels it, which gives the scene its gel. Prints notes about both."""
    from tacsim.config import load_scene, load_sensor
    from tacsim.config.gel import fit_gel, overridden_gel_sizes
    from tacsim.geometry.shapes import describe_meshes

    given = {name: getattr(shape, name) for name in ("radius", "height", "size", "scale")}
    given["repair"] = True if shape.repair else None
    changes = [_geometry_override(indenter, given), *_orientation_overrides(shape.down, shape.rotation)]
    if shape.edge_radius is not None:
        changes.append(f"indenter.edge_radius={shape.edge_radius!r}")
    scene = load_scene("press", [f"preset={preset}", *changes, *overrides])
    model = load_sensor(sensor).model_copy(update={"view": None})
    sizes = overridden_gel_sizes(text.partition("=")[0].split(".") for text in overrides)
    scene, said = fit_gel(scene, {"lower": model}, given=sizes)
    for words in [*said, *describe_meshes(scene)]:
        notes.print(words)
    return scene, model


def _print_press(config: dict[str, Any], max_missed: float) -> None:
    """Prints the result of a press, and what limits its trust. max_missed: share of the depth that the gel may miss."""
    results.print(f"pressing side    {config['pressing_side']}")
    results.print(f"force            {config['force']:.4f} N")
    results.print(f"contact radius   {config['contact_radius'] * 1e3:.3f} mm")
    results.print(f"deepest          {config['deepest'] * 1e3:.3f} mm")
    if config["edge_radius"] is not None:
        requested = config["indenter"]["edge_radius"]
        words = " (smallest for this mesh; --edge-radius '0 mm' for sharp edges)" if requested is None else ""
        results.print(f"edge radius      {config['edge_radius'] * 1e3:.3f} mm{' (sharp)' if requested == 0 else words}")
    if config["unfelt"] > max_missed:
        notes.print(
            f"warning: the gel is pressed by {1 - config['unfelt']:.0%} of the depth: a tip or edge is too narrow for "
            f"elements of {config['element_size'] * 1e3:g} mm, the force too small (a wedge's by 10 to 25 %); lower "
            "element_size"
        )
    if config["folded"]:
        notes.print("note: the gel folds over itself; image and height show the layer that the camera sees")
    if not config["settled"]:
        held = "not held" if config["residual"] is None else f"relative residual {config['residual']:.2g}"
        notes.print(f"warning: not settled, {config['unfollowed'] or f'{held}; raise settling.max_substeps'}")


def _orientation_overrides(down: str | None, rotation: tuple[float, ...] | None) -> list[str]:
    """The overrides that rotate an indenter. Raises typer.BadParameter if both options are given."""
    from tacsim.geometry.pressing_side import SIDES

    if down is not None and rotation is not None:
        raise typer.BadParameter("give --down or --rotation, not both", param_hint="--rotation")
    angles = rotation if down is None else SIDES[down]
    return [] if angles is None else [f"indenter.{axis}={angle!r}" for axis, angle in zip(AXES, angles, strict=False)]


def _geometry_override(indenter: str, given: dict[str, Any]) -> str:
    """The override that puts an indenter into a scene. Raises typer.BadParameter for an unknown shape, and for a
    `given` value that the shape does not have."""
    usual: dict[str, dict[str, Any]] = {
        "sphere": {"radius": 4e-3},
        "cylinder": {"radius": 4e-3, "height": 5e-3},
        "box": {"size": (5e-3, 5e-3, 5e-3)},
    }
    from tacsim.geometry.mesh_file import SUFFIXES

    mesh = {"path": str(Path(indenter).absolute()), "scale": None, "repair": False}
    if indenter not in usual and not indenter.lower().endswith(SUFFIXES):
        known = f"sphere, cylinder, box, or the path of a mesh file ({', '.join(SUFFIXES)})"
        other_words = {"ball": "sphere", "cube": "box", "cuboid": "box", "rod": "cylinder"}
        hint = suggest_word(other_words.get(indenter.lower(), indenter), usual)
        words = f"'{indenter}' is not an indenter; allowed: {known}{hint}"
        raise typer.BadParameter(words, param_hint="INDENTER")
    described = usual.get(indenter, mesh)
    for name, value in given.items():
        if value is not None and name not in described:
            has = " and ".join(f"--{own}" for own in described if own != "path")
            words = f"'{indenter}' does not have it; it has {has}"
            raise typer.BadParameter(words, param_hint=f"--{name}")
    own = {name: value for name, value in given.items() if value is not None}
    shape = indenter if indenter in usual else "mesh"
    return f"indenter.geometry={json.dumps({'shape': shape, **described, **own})}"


def reproduce(
    physics: Annotated[
        Literal["both", "hybrid", "seed"], typer.Option(help="The seed's scheme, that of tacsim (hybrid), or both.")
    ] = "both",
    out: Out = None,
) -> None:
    """Repeat the seed paper's experiment: fig4.png and fig4.json; exit code 1 if its result is not reproduced.

    Squeeze and reposition move through their goal and beyond. The reward must rise to a peak at the goal
    (closest distance at most 0.05 mm and 0.1 mm), then fall by more than five times that.

    Example: tacsim reproduce --physics hybrid --out fig4
    """
    folder = new_directory(out, "reproduce")
    schemes = ["seed", "hybrid"] if physics == "both" else [physics]
    with busy("loading"):
        from robot.studies import experiment
        from tacsim.physics.failure.dump import dump_to_folder
        from tacsim.report.figure4 import draw_figure4

    # The longest trials first, so that no processor is idle at the end.
    wanted = [(task, scheme) for scheme in schemes for task in ("reposition", "squeeze")]
    notes.print("The first run compiles the kernels of each physics, up to a minute.")
    with Interrupt() as interrupt, dump_to_folder(folder / "diverged"), progress() as bar:
        rows = {trial: bar.add_task(", ".join(trial), total=None) for trial in wanted}
        try:
            found = experiment.run_trials(wanted, lambda *trial: bar.advance(rows[trial]), interrupt)
        except experiment.TrialsStopped:
            print_error("stopped by a signal; nothing is written")
            raise typer.Exit(interrupt.exit_code) from None
    trials = {task: {scheme: found[task, scheme] for scheme in schemes} for task in experiment.EXPERIMENTS}
    picture, table = folder / "fig4.png", folder / "fig4.json"
    with writing(folder, new=True), busy("drawing"):
        table.write_text(json.dumps(experiment.as_json(trials), indent=1, allow_nan=False) + "\n", encoding="utf-8")
        draw_figure4(trials, picture)
    print_files(picture, table)
    problems = _report_trials(trials)
    print_json({"trials": experiment.as_json(trials), "problems": problems}, [picture, table])
    if problems:
        raise typer.Exit(1)


def _report_trials(trials: dict[str, dict[str, Trial]]) -> list[str]:
    """Prints one line per trial; returns what is wrong with them."""
    from robot.studies.experiment import shortcomings

    found: list[str] = []
    for task, schemes in trials.items():
        for scheme, trial in schemes.items():
            problems = shortcomings(task, trial)
            said = "; ".join(problems) or f"closest {trial.distance[trial.peak] * 1e3:.3f} mm at step {trial.peak}"
            results.print(f"{'FAILED' if problems else 'ok':8}{task}, {scheme}: {said}")
            found += [f"{task}, {scheme}: {problem}" for problem in problems]
    return found


def debug(
    dump: Annotated[Path, typer.Argument(help="Folder of a dump, named in the error: OUT/diverged/00.")],
    again: Annotated[bool, typer.Option("--replay/--no-replay", help="Run the motion again.")] = True,
) -> None:
    """Inspect a diverged simulation: a table, a section through body and gels (debug.png), and a replay of the motion.

    Exit code 1 if it diverges again. Dumps are written by tacsim run and reproduce below their --out folder, and by any
    simulation into the folder that the environment variable TACSIM_DUMPS names.

    Example: tacsim debug runs/first/diverged/00
    """
    with busy("reading"):
        from robot.studies import dump_view
        from tacsim.physics.failure.dump import read_dump

        found = read_dump(dump)
        world = dump_view.open_world(found)
    results.print(found.info.message)
    results.print(", ".join(f"{name} {version}" for name, version in found.info.versions.items()))
    table = dump_view.table(found)
    for row, values in {"": dump_view.TITLES, **table}.items():
        shown = "".join(f"{values.get(moment, ''):50}" for moment in dump_view.TITLES)
        results.print(f"{row:38}{shown.rstrip()}")
    picture = (dump.parent if dump.name == "dump.json" else dump) / "debug.png"
    with busy("drawing"):
        dump_view.draw(found, picture)
    failure, outcome = None, None
    if again:
        with busy("running the motion again"):
            failure, outcome = dump_view.replay(found, world)
        results.print(f"replay    {outcome}")
    print_files(picture)
    print_json(
        {"message": found.info.message, "versions": found.info.versions, "table": table, "replay": outcome}, [picture]
    )
    if failure is not None:
        raise typer.Exit(EXIT_FAILED)

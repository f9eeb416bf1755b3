"""`tacsim compare`: the similarity of two sources of tactile frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from robot.cli.options import OptionGroup, Out, Overrides, complete_names, with_option_groups
from robot.cli.output import (
    busy,
    counted,
    new_directory,
    notes,
    print_files,
    print_json,
    results,
    show_table,
    warn,
    writing,
)
from robot.cli.terminal import print_error
from tacsim.models.text import suggest_file, suggest_word

if TYPE_CHECKING:
    from calibration.bundle import Calibration
    from calibration.compare.compare import Comparison
    from calibration.compare.invariance import Report
    from calibration.frame_set import FrameSet

Corners = tuple[tuple[float, float], tuple[float, float], tuple[float, float], tuple[float, float]]
LENGTHS = ("height_rmse", "surface_radius", "surface_centroid", "marker_error")  # figures that may have a unit
Pair = Literal["auto", "name", "order"]
Limit = tuple[str, float, bool]  # name, value, True: above it is a failure


class Sources(OptionGroup):
    """Options that describe one of the two sources."""

    reference_a: Annotated[
        Path | None,
        typer.Option(help="A without contact.", show_default="background.png or the like, the episode's, or a median"),
    ] = None
    reference_b: Annotated[Path | None, typer.Option(help="B without contact.", show_default="as for A")] = None
    calibration_a: Annotated[
        Path | None, typer.Option(metavar="BUNDLE", help="A's calibration: metres, and height in its pictures.")
    ] = None
    calibration_b: Annotated[Path | None, typer.Option(metavar="BUNDLE", help="B's calibration.")] = None
    corners_a: Annotated[
        str | None, typer.Option(metavar="U,V U,V U,V U,V", help="The gel's corners in A, clockwise from the top left.")
    ] = None
    corners_b: Annotated[str | None, typer.Option(metavar="U,V U,V U,V U,V", help="The same in B.")] = None
    sensor_a: Annotated[str, typer.Option(help="Sensor of A, if its episode has more than one.")] = ""
    sensor_b: Annotated[str, typer.Option(help="The same for B.")] = ""


@with_option_groups
def compare(
    a: Annotated[
        str,
        typer.Argument(
            metavar="A",
            help="Folder of pictures, video, episode, or scene with a ball.",
            autocompletion=complete_names("scene"),
        ),
    ],
    b: Annotated[Path, typer.Argument(metavar="B", help="Folder, video or episode that counts as ground truth.")],
    *,
    sources: Sources,
    pair: Annotated[Pair, typer.Option(help="auto: by name where all names are the same, else in order.")] = "auto",
    shift: Annotated[
        bool | None,
        typer.Option("--shift/--no-shift", help="Find the shift between A and B.", show_default="unless A is a scene"),
    ] = None,
    invariance: Annotated[
        bool,
        typer.Option("--invariance", help="Also: can a policy distinguish A from B? (rho, AUC, drift of the light)"),
    ] = False,
    fail_above: Annotated[
        list[str] | None, typer.Option(metavar="METRIC=VALUE", help="Exit code 1 if above; may be repeated.")
    ] = None,
    fail_below: Annotated[
        list[str] | None, typer.Option(metavar="METRIC=VALUE", help="Exit code 1 if below; may be repeated.")
    ] = None,
    set_: Overrides = None,
    out: Out = None,
) -> None:
    """Compare frames of A with frames of B; each figure is shown with its values for no contact and for noise alone.

    Writes compare.json, compare.csv and compare.html. A may be a scene with a ball (press): then the ball is pressed in
    the simulator where B's frames show a contact, and rendered with B's calibration; --set changes that scene, whose
    gel has elements of 0.25 mm unless element_size or preset is set.

    Example: tacsim compare sim real --calibration-b bundle --fail-above contact_mae=8
    """
    folder = new_directory(out, "compare")
    with busy("loading"):
        from calibration.bundle import read_bundle
        from calibration.compare.compare import Options, Pairing
        from calibration.compare.compare import compare_frames as run
        from calibration.compare.invariance import measure_invariance
        from calibration.compare.report import comparison_as_json, comparison_figures, write_comparison
    limits = [*_parse_limits(fail_above, "--fail-above"), *_parse_limits(fail_below, "--fail-below")]
    bundles = [
        None if path is None else read_bundle(path)[0] for path in (sources.calibration_a, sources.calibration_b)
    ]
    made, truth = _read_sources(a, b, sources, bundles, set_ or [])
    # from here on all images with a calibration are metric
    bundles = [None if each is None else each.model_copy(update={"view": None}) for each in bundles]
    made, truth = _rectify_corners(made, truth, (sources.corners_a, sources.corners_b), bundles)
    with counted("comparing") as on_step:
        result = run(made, truth, bundles[0], bundles[1], Options(Pairing(pair), shift), on_step)
    report = None
    if invariance:
        with counted("invariance") as on_step:
            report = measure_invariance([(result, bundles[1])], on_step=on_step)
    values = comparison_figures(result, report)
    beyond = _beyond_limits(limits, values)
    with writing(folder, new=True), busy("writing"):
        written = write_comparison(folder, result, report)
    _print_comparison(result, report)
    print_files(*written)
    print_json({**comparison_as_json(result, report), "beyond_limits": beyond}, written)
    for words in beyond:
        print_error(words)
    if beyond:
        raise typer.Exit(1)


def _read_sources(
    a: str, b: Path, sources: Sources, bundles: Sequence[Calibration | None], overrides: list[str]
) -> tuple[FrameSet, FrameSet]:
    """The frames of A and of B. Those of a scene are presses where B shows a contact, with `overrides` of the scene.

    Raises BadFrames.
    """
    from calibration.errors import BadFrames
    from tacsim.config import shipped_names

    if not Path(a).exists() and not _is_scene(a):
        hint = suggest_word(a, shipped_names("scene")) or suggest_file(Path(a), (".mcap", ".mp4", ".avi"))
        raise BadFrames(f"{a}: no such file or folder, and no shipped scene{hint}")
    truth = _read_frames(b, sources.reference_b, sources.sensor_b, bundles[1])
    if not _is_scene(a):
        if overrides:
            raise BadFrames(f"--set changes a scene, but A is no scene: {a}")
        return _read_frames(Path(a), sources.reference_a, sources.sensor_a, bundles[0]), truth
    if sources.corners_a or sources.corners_b or sources.reference_a or sources.sensor_a:
        raise BadFrames(f"A is the scene '{a}': it has no corners, reference or sensor, and B must be calibrated")
    return _simulate_presses(a, truth, sources.calibration_b, overrides), truth


def _read_frames(path: Path, reference: Path | None, sensor: str, bundle: Calibration | None) -> FrameSet:
    """Reads frames, and rectifies them if their calibration has a view."""
    from calibration.frame_set import read_frame_set, rectified_by_view

    with busy(f"reading {path}"):
        frames = read_frame_set(path, reference, sensor)
    return frames if bundle is None or bundle.view is None else rectified_by_view(frames, bundle.view)


def _is_scene(a: str) -> bool:
    """True for the name of a shipped scene that is not a file or folder here, and for a .yaml file."""
    from tacsim.config import shipped_names

    return a.lower().endswith((".yaml", ".yml")) or (not Path(a).exists() and a in shipped_names("scene"))


def _simulate_presses(name: str, truth: FrameSet, bundle: Path | None, overrides: list[str]) -> FrameSet:
    """Simulates A's frames."""
    from calibration.bundle import read_bundle, read_sensor_model
    from calibration.errors import BadFrames
    from robot.studies.matched_press import ELEMENT
    from tacsim.config import load_scene
    from tacsim.config.gel import fit_gel, overridden_gel_sizes
    from tacsim.models.scene import Sphere
    from tacsim.models.sensor import CanonicalGrid

    if bundle is None:
        raise BadFrames("a scene is rendered with the light of B: give B's calibration (--calibration-b)")
    settings, sensor = ["preset=standard", *overrides], read_sensor_model(bundle)
    own = name == "press" and not any(text.startswith("indenter.geometry") for text in overrides)
    if own:
        settings.append(f"indenter.geometry.radius={read_bundle(bundle)[0].provenance.ball_radius} m")
    scene = load_scene(name, settings)
    if scene.element_size is None and not any(text.startswith("preset=") for text in overrides):
        # a gel needs at least two layers
        scene = load_scene(name, [*settings, f"element_size={min(ELEMENT, scene.gel.size[2] / 2)} m"])
    given = overridden_gel_sizes(text.partition("=")[0].split(".") for text in overrides)
    scene, said = fit_gel(scene, {"of B": sensor}, given=given)
    if scene.indenter is not None and isinstance(ball := scene.indenter.geometry, Sphere):
        words = ", as in the calibration; for another --set 'indenter.geometry.radius=3 mm'" if own else ""
        said = [f"a ball of {ball.radius * 1e3:.4g} mm radius{words}", *said]
    for words in said:
        notes.print(words)
    notes.print("pressing (the first run compiles the kernels, up to half a minute)")
    from robot.studies.matched_press import match_presses

    with counted("pressing") as on_press:
        metric = sensor.model_copy(update={"view": None})
        made, failed = match_presses(truth, scene, metric, CanonicalGrid(), on_press)
    return replace(made, notes=tuple(failed))


def _rectify_corners(
    a: FrameSet, b: FrameSet, texts: tuple[str | None, str | None], bundles: list[Calibration | None]
) -> tuple[FrameSet, FrameSet]:
    """Rectifies the sides whose corners of the gel are given, to B's size."""
    from calibration.errors import BadFrames
    from calibration.frame_set import rectified_by_corners, rectified_shape

    corners = [None if text is None else _parse_corners(text) for text in texts]
    for side, given, bundle in zip("ab", corners, bundles, strict=True):
        if given is not None and bundle is not None:
            raise BadFrames(
                f"--corners-{side} and --calibration-{side}: a calibration contains the position of the gel; give one"
            )
    shape = b.shape if corners[1] is None else rectified_shape(corners[1])
    straight_b = b if corners[1] is None else rectified_by_corners(b, corners[1], shape)
    return (a if corners[0] is None else rectified_by_corners(a, corners[0], shape)), straight_b


def _parse_corners(text: str) -> Corners:
    try:
        points = [tuple(float(number) for number in point.split(",")) for point in text.split()]
    except ValueError:
        points = []
    if len(points) != 4 or any(len(point) != 2 for point in points):
        raise typer.BadParameter(
            f"'{text}' is not four points; for example \"67,68 465,113 475,383 73,437\"",
            param_hint="--corners-a, --corners-b",
        )
    return tuple(points)  # type: ignore[return-value]


def _parse_limits(texts: list[str] | None, option: str) -> list[Limit]:
    """Parsed METRIC=VALUE. A length may carry its unit."""
    from calibration.compare.report import figure_names
    from tacsim.models.quantity import parse_quantity

    found = []
    for text in texts or []:
        name, equals, value = text.partition("=")
        if name not in figure_names():
            raise typer.BadParameter(
                f"'{name}' is not a figure; allowed: {', '.join(figure_names())}{suggest_word(name, figure_names())}",
                param_hint=option,
            )
        try:
            number = parse_quantity(value.strip(), "length") if name in LENGTHS else float(value)
        except ValueError as error:
            raise typer.BadParameter(f"'{text}': {error}", param_hint=option) from None
        if not equals or number != number:
            raise typer.BadParameter(f"'{text}' is not METRIC=VALUE", param_hint=option)
        found.append((name, number, option == "--fail-above"))
    return found


def _beyond_limits(limits: list[Limit], values: dict[str, float]) -> list[str]:
    """Messages about figures beyond their limits. Raises BadParameter for a limit of a figure that could not be
    measured."""
    unknown = [name for name, _, _ in limits if values[name] != values[name]]
    if unknown:
        raise typer.BadParameter(
            f"not measured in these frames: {', '.join(unknown)}. Surfaces need the calibrations of both sides (or "
            "recordings of simulations), rho, auc and drift need --invariance",
            param_hint="--fail-above, --fail-below",
        )
    return [
        f"{name} is {values[name]:.4g}, {'above' if above else 'below'} {limit:g}"
        for name, limit, above in limits
        if (values[name] > limit if above else values[name] < limit)
    ]


def _print_comparison(result: Comparison, report: Report | None) -> None:
    from calibration.compare.report import (
        describe_against_null,
        describe_comparison,
        format_metric,
        known_metrics,
    )

    results.print(describe_comparison(result))
    width = None if results.is_terminal else 160
    overall_rows = (
        (
            metric.label, metric.unit or "1", format_metric(overall.mean, metric),
            f"{format_metric(overall.low, metric)} to {format_metric(overall.high, metric)}",
            format_metric(overall.null, metric), format_metric(overall.floor, metric), describe_against_null(overall),
        )
        for metric, overall in known_metrics(result)
    )  # fmt: skip
    columns = ("metric", "unit", " against ".join(result.names), "95 % interval", "null", "floor", "than null")
    show_table(
        f"{len(result.pairs)} pair{'s' * (len(result.pairs) != 1)}", columns, overall_rows, left={0, 1}, width=width
    )
    if report is not None:
        _print_invariance(report, width)
    notes.print(result.alignment.description)
    for words in result.notes:
        warn(words)
    flagged = [pair for pair in result.pairs if pair.flags]
    for pair in flagged[:10]:
        warn(f"{pair.a.name} / {pair.b.name}: {'; '.join(pair.flags)}")
    if len(flagged) > 10:
        notes.print(f"... and {len(flagged) - 10} more flagged pairs, in the files")


def _print_invariance(report: Report, width: int | None) -> None:
    views = (
        (
            view.view, f"{view.rho:.2f}", f"{view.rho_low:.2f} to {view.rho_high:.2f}",
            f"{view.auc:.2f}", f"{view.auc_low:.2f} to {view.auc_high:.2f}",
        )
        for view in report.views
    )  # fmt: skip
    title = f"Invariance, {report.presses} presses, patch {report.patch}"
    show_table(title, ("view", "rho (1)", "95 %", "AUC (1)", "95 %"), views, left={0}, width=width)
    if report.drifts:
        drifts = (
            (row.change.name, *("–" if math.isnan(value) else f"{value:.2f}" for value in (row.fresh, row.stale)))
            for row in report.drifts
        )
        title = f"Extra gradient error under drift (°), beyond {report.angle:.1f}"
        show_table(title, ("change", "fresh reference", "stale"), drifts, left={0}, width=width)
    for words in report.notes:
        warn(words)

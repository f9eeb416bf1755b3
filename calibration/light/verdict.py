"""Verdict on a calibrated light: limits for all sensors, advice if one is exceeded, and a page (one self-contained HTML
file) with a picture of residuals."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from calibration.light import tuning
from calibration.light.dent import contact_depth
from calibration.light.fit import LightFit
from tacsim.interface import Image
from tacsim.models.photometric import PhotometricLight, PhotometricModel
from tacsim.report.report import data_url, render_page

Word = Literal["good", "usable", "unverified scale", "do not trust"]
ORDER: tuple[Word, ...] = ("do not trust", "unverified scale", "usable", "good")  # the worst first

GREY = "the pictures are grey"
PAGE_FILE = "verdict.html"


@dataclass(frozen=True, slots=True)
class Finding:
    """A finding that lowers the verdict."""

    word: Word
    what: str
    todo: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """The judgement of a calibration."""

    findings: tuple[Finding, ...]

    @property
    def word(self) -> Word:
        words = [finding.word for finding in self.findings]
        return next((word for word in ORDER if word in words), "good")

    def __str__(self) -> str:
        return "; ".join([self.word, *(f"{finding.what}: {finding.todo}" for finding in self.findings)])


@dataclass(frozen=True, slots=True)
class KnownScale:
    """Known lengths in addition to ball and pixel pitch; None: not known."""

    pixel_pitch: float  # [m]
    ball_radius: float  # [m]
    gel_size: tuple[float, float] | None = None  # of the gel in the picture [m]
    gel_thickness: float | None = None  # [m]
    depths: tuple[tuple[str, float], ...] = ()  # frames whose indentation is known [m]
    pitch_from_size: bool = False  # the pitch is the published one, computed from `gel_size`: neither checks the other
    marker_pitches: tuple[float, float] | None = None  # of printed dots: as found by the pixel pitch, as given [m]


def evaluate_calibration(fit: LightFit, scale: KnownScale, *, dots: bool = False) -> Verdict:
    """All findings, the worst first. dots: the pictures show dots without an option for them."""
    found = [*_check_presses(fit), *_check_images(fit), *_check_shape(fit), *_check_scale(fit, scale)]
    found += [Finding("do not trust", *_split_warning(doubt)) for doubt in fit.image_warnings]
    if dots:  # a rig refuses such a bundle
        found.insert(
            0, Finding("do not trust", "dots are printed on the gel, and each will pass for a dent", "give --markers")
        )
    found += [Finding("usable", *_split_warning(warning)) for warning in fit.warnings]
    return Verdict(tuple(sorted(found, key=lambda finding: ORDER.index(finding.word))))


def _check_presses(fit: LightFit) -> Iterable[Finding]:
    count = len(fit.presses)
    if count < tuning.GOOD_PRESSES:
        # depth needs one table, which one press gives; slopes need colours of all directions everywhere
        word: Word = "do not trust" if count < tuning.MIN_PRESSES and fit.darkness is None else "usable"
        todo = "press five at least, eight are good"
        if fit.darkness is not None:
            todo = "that gives the table of darkness, five presses tell whether it holds"
        yield Finding(word, f"{count} press{'es' * (count > 1)} could be used", todo)
    yield from _exceed_limits(
        tuning.MAX_RADIUS_UNCERTAINTY, fit.radius_uncertainty, "the contact radii are uncertain by {:.0%}",
        "press more often and deeper; is each picture of one ball, held still?",
    )  # fmt: skip
    share = len(fit.left_out) / (count + len(fit.left_out))
    if share > tuning.MAX_LEFT_OUT:
        yield Finding(
            "do not trust", f"{len(fit.left_out)} of {count + len(fit.left_out)} presses were left out",
            "see why below, and press again: one ball, one sensor, one setting of its camera",
        )  # fmt: skip
    misfit = [press.name for press in fit.predictions if press.error > tuning.MAX_ERROR_RATIO * press.null_error]
    if misfit:
        yield Finding("usable", f"the circle of {_join_names(misfit)} does not fit", "look at it, and leave it out")


def _check_images(fit: LightFit) -> Iterable[Finding]:
    unexplained = float(np.mean(fit.residual_shares))
    if fit.forward is not None and is_grey(fit.reference):
        yield Finding(
            "do not trust", f"{GREY}, and one number a pixel cannot tell slopes of two directions",
            "calibrate from the camera's own pictures, in colour",
        )  # fmt: skip
    if fit.forward is not None and is_isotropic(fit.forward):
        yield Finding(
            "do not trust", "this light tells no direction: all flanks of a dent change alike",
            "slopes cannot be found in such pictures; only how dark it is tells of depth",
        )  # fmt: skip
    yield from _exceed_limits(
        tuning.RESIDUAL_LIMITS, unexplained, "{:.0%} of what the presses change is no smooth function of the slope",
        "shadows, or a light that tells no direction; is the ball a ball, and exposure fixed?",
    )  # fmt: skip
    if not fit.predictions:
        return
    yield from _exceed_limits(
        tuning.NORMAL_ERROR_LIMITS, float(np.mean([press.angle for press in fit.predictions])),
        "normals of presses that took no part are off by {:.1f} degrees",
        "look at residuals.png: what do the worst show?",
    )  # fmt: skip
    correlation = float(np.mean([press.correlation for press in fit.predictions]))
    yield from _exceed_limits(
        (-tuning.MIN_CORRELATION[0], -tuning.MIN_CORRELATION[1]), -correlation,
        f"pictures of presses that took no part are predicted with a correlation of {correlation:.3f}",
        "exposure and white balance fixed? a picture without contact of the same session?",
    )  # fmt: skip


def _check_shape(fit: LightFit) -> Iterable[Finding]:
    if fit.stretch is not None:
        unsure = 0.0 if math.isnan(fit.stretch.uncertainty) else 2 * fit.stretch.uncertainty
        yield from _exceed_limits(
            tuning.MAX_STRETCH, fit.stretch.ratio - 1.0 - unsure,
            f"contacts of the ball are no circles: the ratio of their axes is {fit.stretch}; only below "
            f"{1 + tuning.MAX_STRETCH[0] + unsure:.3f} it cannot be distinguished from 1",
            "give pictures whose pixels are square, or the view of the gel (--view)",
        )  # fmt: skip


def _check_scale(fit: LightFit, scale: KnownScale) -> Iterable[Finding]:
    ball = scale.ball_radius / scale.pixel_pitch
    ratios = [press.circle.radius / ball for press in fit.presses]
    wide = [
        press.name for press, ratio in zip(fit.presses, ratios, strict=True) if ratio > tuning.MAX_PRESS_CONTACT_RATIO
    ]
    if len(wide) > len(ratios) / 3 or (
        len(ratios) >= tuning.MIN_PRESSES and min(ratios) > tuning.MAX_COMMON_CONTACT_RATIO
    ):
        yield Finding(
            "do not trust", f"pitch or radius is wrong: contact radius over ball radius a/R = {np.median(ratios):.2f}",
            "measure the ball by a calliper (its radius is half of that) and the pitch by a board or a ruler",
        )  # fmt: skip
    elif wide:
        yield Finding(
            "usable", f"the contact of {_join_names(wide)} is as wide as the ball",
            "measure ball (is it the radius that was given?) and pitch; if both are right, leave it out",
        )  # fmt: skip
    elif max(ratios) < tuning.MIN_WIDEST_CONTACT_RATIO:
        yield Finding(
            "usable", f"no contact is wider than {max(ratios):.2f} of the ball: light presses, a diameter given for "
            "the radius, or too small a pixel pitch", "measure ball and pitch; press as deep as the work will",
        )  # fmt: skip
    # A pitch 1.6 times too large may look as good as the right one
    if not scale.depths:
        if scale.pitch_from_size:
            yield Finding(
                "unverified scale",
                "the pixel pitch is the published one of this kind of sensor, and nothing checks it on yours",
                "measure it (--pixel-pitch, --view) or the gel that the picture shows (--size), or say how deep a "
                "press is (--depth)",
            )  # fmt: skip
        elif scale.gel_size is None and scale.marker_pitches is None:
            yield Finding(
                "unverified scale", "nothing checks the lengths that were given, ball and pixel pitch",
                "say how deep a press is (--depth, which checks both), what the picture shows of the gel (--size, or "
                "--kind), or how far its dots are apart (--marker-pitch)",
            )  # fmt: skip
        else:
            yield Finding(
                "usable", "the pixel pitch is checked and the ball's radius is not: half of it doubles each depth",
                "say how deep a press is (--depth)",
            )  # fmt: skip
    if scale.marker_pitches is not None:
        found, given = scale.marker_pitches
        yield from _exceed_limits(
            tuning.MAX_SCALE_ERROR, abs(math.log(found / given)),
            f"at this pixel pitch the dots are {found * 1e3:.3g} mm apart, and {given * 1e3:.3g} mm were given",
            "measure the pixel pitch by a board or a ruler",
        )  # fmt: skip
    if scale.gel_size is not None:
        rows, columns, _ = fit.reference.shape
        shown = columns * scale.pixel_pitch, rows * scale.pixel_pitch
        off = max(abs(math.log(one / other)) for one, other in zip(shown, scale.gel_size, strict=True))
        yield from _exceed_limits(
            tuning.MAX_SCALE_ERROR, off,
            f"at this pitch the picture shows {_size_text(shown)}, and {_size_text(scale.gel_size)} of the gel "
            "are to be seen",
            "measure the pitch by a board or a ruler",
        )  # fmt: skip
    if scale.gel_thickness is not None:
        yield from _check_thickness(fit, scale, max(ratios))
    known = dict(scale.depths)
    # What slopes say of a thick gel is too uncertain for this: the far end of its skirts is taken for drift
    layer = fit.thickness if fit.thickness < tuning.MAX_IDENTIFIABLE_THICKNESS * ball else 1e4 * ball
    if scale.gel_thickness is not None:
        layer = scale.gel_thickness / scale.pixel_pitch
    factors = [
        math.sqrt(known[press.name] / contact_depth(press.circle.radius, ball, layer) / scale.pixel_pitch)
        for press in fit.presses
        if press.name in known
    ]
    if factors:
        factor = float(np.median(factors))
        yield from _exceed_limits(
            tuning.MAX_SCALE_ERROR, abs(math.log(factor)),
            f"pitch or radius is wrong: by the depth that is known contacts are {factor:.2f} times as wide as found "
            f"(a/R = {np.median(ratios):.2f})", "measure pitch and ball; is the depth counted from the first touch?",
        )  # fmt: skip


def _check_thickness(fit: LightFit, scale: KnownScale, widest: float) -> Iterable[Finding]:
    configured = scale.gel_thickness
    assert configured is not None
    depth = widest**2 * scale.ball_radius
    yield from _exceed_limits(
        tuning.MAX_DEPTH_RATIO, depth / configured,
        f"the deepest press is {depth * 1e3:.1f} mm deep in a gel of {configured * 1e3:.1f} mm",
        "measure ball and pitch; press less deep",
    )  # fmt: skip
    by_slopes = fit.thickness * scale.pixel_pitch
    if by_slopes < configured / tuning.MAX_THICKNESS_RATIO:
        yield Finding(
            "usable", f"near the contacts the gel moves like one of {by_slopes * 1e3:.1f} mm, its given thickness "
            f"is {configured * 1e3:.1f} mm", "is the pixel pitch right?",
        )  # fmt: skip


def _exceed_limits(limits: tuple[float, float], value: float, what: str, todo: str) -> Iterable[Finding]:
    """A finding if `value` exceeds the first limit; none for NaN."""
    if value > limits[0]:
        yield Finding("do not trust" if value > limits[1] else "usable", what.format(value), todo)


def is_grey(image: Image) -> bool:
    """True for a picture (H, W, 3) with equal channels."""
    return bool((image == image[..., :1]).all())


def is_isotropic(model: PhotometricModel) -> bool:
    """True if flanks in all directions have nearly the same change of colour."""
    turn = np.arange(8) * np.pi / 4
    slopes = 0.6 * model.steepest * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    middle = np.zeros(8, dtype=np.float32)
    change, _ = PhotometricLight(model).change(slopes.astype(np.float32), middle, middle)
    away = change - change.mean(axis=0)
    return float((away**2).sum()) < tuning.MIN_DIRECTED_SHARE * float((change**2).sum())


def _join_names(names: list[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def _size_text(size: tuple[float, float]) -> str:
    return f"{size[0] * 1e3:.1f} x {size[1] * 1e3:.1f} mm"


def _split_warning(warning: str) -> tuple[str, str]:
    """Splits a warning "finding: advice" into its two parts."""
    what, _, todo = warning.partition(": ")
    return what, todo


def write_page(
    path: Path, name: str, fit: LightFit, scale: KnownScale, verdict: Verdict, residuals: Path | None, facts: list[str]
) -> None:
    """Writes the page of sensor `name`. residuals: its picture. facts: lines with other data of the sensor. Raises
    OSError."""
    ball = scale.ball_radius / scale.pixel_pitch
    ratios = [press.circle.radius / ball for press in fit.presses]
    picture = None if residuals is None else data_url(residuals.read_bytes())
    means = {
        what: float(np.mean([getattr(press, what) for press in fit.predictions])) if fit.predictions else None
        for what in ("angle", "correlation", "error", "null_error")
    }
    page = render_page(
        Path(__file__).with_name("verdict.html.jinja"), name=name, fit=fit, scale=scale, verdict=verdict,
        picture=picture, facts=facts, ratios=ratios, means=means,
        rows=sorted(fit.predictions, key=lambda press: -press.angle),
    )  # fmt: skip
    path.write_text(page, encoding="utf-8")


def draw_residuals(fit: LightFit, path: Path) -> None:
    """Writes a PNG: for each press the observed change of colour, its prediction by the others, and the error, all in
    one scale. Raises ValueError for a fit of one press, which has no prediction; OSError."""
    half_side = 2.0  # of what is drawn [contact radii]
    max_drawn = 8  # drawn, the worst first
    from matplotlib.figure import Figure

    predictions = sorted(fit.predictions, key=lambda press: -press.error)[:max_drawn]
    if not predictions:
        raise ValueError("a calibration from one press leaves none out: there is nothing to draw")
    figure = Figure(figsize=(6.4, 1.9 * len(predictions)), layout="constrained")
    axes = figure.subplots(len(predictions), 3, squeeze=False)
    for row, press in zip(axes, predictions, strict=True):
        reach = half_side * press.circle.radius
        rows = slice(max(0, round(press.circle.y - reach)), round(press.circle.y + reach) + 1)
        columns = slice(max(0, round(press.circle.x - reach)), round(press.circle.x + reach) + 1)
        seen, predicted = press.real[rows, columns], press.predicted[rows, columns]
        for axis, change in zip(row, (seen, predicted, predicted - seen), strict=True):
            axis.imshow(np.clip(128 + change, 0, 255).astype(np.uint8))
            axis.set_xticks([])
            axis.set_yticks([])
        row[0].set_ylabel(press.name, fontsize=7)
        row[2].set_title(f"{press.error:.1f} of {press.null_error:.1f} grey levels, {press.angle:.1f}°", fontsize=7)
    axes[0, 0].set_title("seen", fontsize=8)
    axes[0, 1].set_title("predicted by the other presses", fontsize=8)
    figure.savefig(path, dpi=120)

"""A comparison as files: compare.json, compare.csv, and compare.html (one self-contained file); and its summary in one
sentence."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.compare.compare import METRICS, Comparison, Metric, Overall
from calibration.compare.invariance import CHANGES, VIEWS, Report
from calibration.compare.tuning import MAX_CLOSE_ERROR, MIN_CLOSE_CORRELATION
from tacsim.interface import Image
from tacsim.report.report import data_url, json_number, render_page

RANKING_METRIC = "contact_mae"
FORMAT = 1

CONTACT_MASK = (
    "Figures named contact are means over the pixels where either picture of a pair differs from its reference as a "
    "contact does, by more than noise and a quarter of the strongest change, drift of the light taken off; pressed "
    "figures and those of the surface over where it lies deeper than half of its depth. Published figures often are "
    "those of a circle that was clicked: they do not compare."
)
FILES = ("compare.json", "compare.csv", "compare.html")
SIDE_NAMES = {"simulated": "the simulation", "real": "the real sensor"}


def comparison_figures(comparison: Comparison, report: Report | None = None) -> dict[str, float]:
    """All figures that a threshold may name; NaN if not known. Units as in the JSON file."""
    found = {key: overall.mean for key, overall in comparison.overall.items()}
    for view in report.views if report else ():
        found |= {f"rho_{view.view}": view.rho, f"auc_{view.view}": view.auc, f"auc_low_{view.view}": view.auc_low}
    for drift in report.drifts if report else ():
        found |= {f"drift_{drift.change.key}": drift.fresh, f"stale_{drift.change.key}": drift.stale}
    return {name: found.get(name, math.nan) for name in figure_names()}


def figure_names() -> list[str]:
    """The names of all figures."""
    views = [f"{what}_{view}" for view in VIEWS for what in ("rho", "auc", "auc_low")]
    drifts = [f"{what}_{change.key}" for change in CHANGES for what in ("drift", "stale")]
    return [*(metric.key for metric in METRICS), *views, *drifts]


def comparison_as_json(comparison: Comparison, report: Report | None = None) -> dict[str, Any]:
    """The result as JSON: lengths in m, angles in degrees, contact radius and centroid in pixels of B; unknown values
    are null."""
    return {
        "format": FORMAT,
        "judgement": describe_comparison(comparison),
        "a": {"name": comparison.a.name, "is": comparison.names[0], "reference": comparison.a.reference_from},
        "b": {"name": comparison.b.name, "is": comparison.names[1], "reference": comparison.b.reference_from},
        "units": {metric.key: metric.si for metric in METRICS},
        "alignment": {"said": comparison.alignment.description, "shift": list(comparison.alignment.shift)},
        "notes": list(comparison.notes),
        "overall": {key: _known_fields(overall) for key, overall in comparison.overall.items()},
        "pairs": [
            {
                "a": pair.a.name,
                "b": pair.b.name,
                "flags": list(pair.flags),
                "numbers": {key: json_number(value) for key, value in pair.numbers.items()},
                "null": {key: json_number(value) for key, value in pair.null.items()},
            }
            for pair in comparison.pairs
        ],
        "invariance": None
        if report is None
        else {
            "presses": report.presses,
            "patch": report.patch,
            "views": {view.view: _known_fields(view, leave="view") for view in report.views},
            "gradient_angle": json_number(report.angle),
            "drift": {
                drift.change.key: {"fresh": json_number(drift.fresh), "stale": json_number(drift.stale)}
                for drift in report.drifts
            },
            "notes": list(report.notes),
        },
    }


def write_comparison(folder: Path, comparison: Comparison, report: Report | None = None) -> list[Path]:
    """Writes the three files into `folder`, which exists, and returns their paths. Raises OSError."""
    paths = [folder / name for name in FILES]
    text = json.dumps(comparison_as_json(comparison, report), indent=1, allow_nan=False)
    paths[0].write_text(text + "\n", encoding="utf-8")
    _write_csv(paths[1], comparison)
    paths[2].write_text(_render_html(comparison, report), encoding="utf-8")
    return paths


def known_metrics(comparison: Comparison) -> list[tuple[Metric, Overall]]:
    """The metrics that are known for at least one pair."""
    found = ((metric, comparison.overall[metric.key]) for metric in METRICS)
    return [(metric, overall) for metric, overall in found if not math.isnan(overall.mean)]


def format_metric(value: float, metric: Metric) -> str:
    """A number in the metric's unit as text; a dash if it is not known."""
    return "–" if math.isnan(value) else "∞" if math.isinf(value) else f"{value * metric.scale:.{metric.digits}f}"


def describe_against_null(overall: Overall) -> str:
    """The comparison with the null, as text."""
    if overall.outperforms_null is None:
        return "–"
    return "better" if overall.outperforms_null else "not better"


def _write_csv(path: Path, comparison: Comparison) -> None:
    keys = [metric.key for metric in METRICS]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["a", "b", *keys, *(f"null_{key}" for key in keys), "flags"])
        for pair in comparison.pairs:
            numbers = [*(pair.numbers.get(key) for key in keys), *(pair.null.get(key) for key in keys)]
            cells = ["" if (value := json_number(number)) is None else repr(value) for number in numbers]
            writer.writerow([_escape_formula(pair.a.name), _escape_formula(pair.b.name), *cells, "; ".join(pair.flags)])


def _escape_formula(name: str) -> str:
    """A file's name that a spreadsheet does not read as a formula."""
    return f"'{name}" if name[:1] in "=+-@\t\r" else name


def _render_html(comparison: Comparison, report: Report | None) -> str:
    max_pair_images = 24  # pairs with pictures, the worst first

    def worst(k: int) -> float:
        value = comparison.pairs[k].numbers[RANKING_METRIC]
        return -math.inf if math.isnan(value) else value

    order = sorted(range(len(comparison.pairs)), key=worst, reverse=True)
    known = known_metrics(comparison)
    columns = [metric for metric, _ in known if metric.key not in ("psnr", "contact_psnr", "mae", "ssim")]
    return render_page(
        Path(__file__).with_name("comparison.html.jinja"),
        comparison=comparison,
        report=report,
        judgement=describe_comparison(comparison),
        mask=CONTACT_MASK,
        rows=known,
        columns=columns,
        shown=format_metric,
        verdict=describe_against_null,
        number=lambda value, digits=2: "–" if math.isnan(value) else f"{value:.{digits}f}",
        pairs=[(comparison.pairs[k], _pair_images(comparison, k)) for k in order[:max_pair_images]],
        rest=[comparison.pairs[k] for k in order[max_pair_images:]],
        nan=math.nan,
    )


def _pair_images(comparison: Comparison, k: int) -> list[tuple[str, str]]:
    """Captions and pictures (data URLs) of a pair."""
    pair = comparison.pairs[k]
    a, b = comparison.aligned(pair.a.image), pair.b.image
    base_a, base_b = comparison.aligned(comparison.a.reference), comparison.b.reference
    change_a, change_b = (_grey_image(one, base) for one, base in ((a, base_a), (b, base_b)))
    error = np.abs(a.astype(np.float32) - b).mean(axis=2)
    name_a, name_b = comparison.names
    near = _contact_box(pair.region)
    found = [
        (f"{name_b}, whole", b),
        (name_a, a[near]),
        (name_b, b[near]),
        (f"{name_a} − its reference", change_a[near]),
        (f"{name_b} − its reference", change_b[near]),
        (f"|{name_a} − {name_b}|, 0 to 64 grey; contact outlined",
         _outline_region(_false_colours(error, 64.0), pair.region)[near]),
    ]  # fmt: skip
    surfaces = comparison.surfaces(k)
    if surfaces is not None:
        height_a, height_b = (surface.height for surface in surfaces)
        deepest = max(float(height_a.max()), float(height_b.max()), 1e-6)
        found += [(f"height of {side}, 0 to {deepest * 1e3:.2f} mm", _false_colours(height, deepest))
                  for side, height in ((name_a, height_a), (name_b, height_b))]  # fmt: skip
    return [(caption, _data_url(picture)) for caption, picture in found]


def _contact_box(region: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Rows and columns of the largest contact of a region (H, W) with its surroundings; of the whole picture without
    contact."""
    zoom_margin = 0.3  # of the contact's width, that a zoomed picture shows round it
    from scipy.ndimage import label

    parts, _ = label(region)
    sizes = np.bincount(parts.ravel())[1:]
    if len(sizes) == 0:
        return slice(None), slice(None)
    largest = parts == 1 + int(sizes.argmax())
    rows_, columns = (np.flatnonzero(largest.any(axis=axis)) for axis in (1, 0))
    half = max(8, round((0.5 + zoom_margin) * max(np.ptp(rows_), np.ptp(columns))))
    middles = ((int(one[0]) + int(one[-1])) // 2 for one in (rows_, columns))
    down, across = (slice(max(0, middle - half), middle + half + 1) for middle in middles)
    return down, across


def _grey_image(image: Image, base: Image) -> Image:
    grey: Image = np.clip(128.0 + (image.astype(np.float32) - base), 0, 255).astype(np.uint8)
    return grey


def _false_colours(field: NDArray[np.floating], full: float) -> Image:
    """(H, W, 3) false colours of a field from 0 to `full`."""
    import cv2

    level = np.clip(np.asarray(field, dtype=np.float32) * (255.0 / full), 0, 255).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO)[..., ::-1], dtype=np.uint8)


def _outline_region(picture: Image, region: NDArray[np.bool_]) -> Image:
    from scipy.ndimage import binary_dilation

    marked = picture.copy()
    marked[binary_dilation(region) & ~region] = 255
    return marked


def _data_url(picture: Image) -> str:
    quality = 85
    longer_side = 240  # longer side [px]
    import cv2

    rows_, columns = picture.shape[:2]
    scale = longer_side / max(rows_, columns)
    size = (max(1, round(columns * scale)), max(1, round(rows_ * scale)))
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST
    small = cv2.resize(picture, size, interpolation=how)
    _, data = cv2.imencode(".jpg", small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data_url(data.tobytes(), "jpeg")


def _known_fields(record: Any, leave: str = "") -> dict[str, Any]:
    """The fields of a flat record, NaN and infinity as None."""
    fields: Iterable[str] = record.__slots__
    values = ((name, getattr(record, name)) for name in fields if name != leave)
    return {name: json_number(value) if isinstance(value, float) else value for name, value in values}


def describe_comparison(comparison: Comparison) -> str:
    """Summary of the similarity of A and B in contact, with differences in grey levels and degrees."""
    a, b = (SIDE_NAMES.get(name, name) for name in comparison.names)
    error, alike = comparison.overall["contact_mae"], comparison.overall["contact_ncc"].mean
    if math.isnan(error.mean):
        return "No pair shows contact, so nothing can be judged."
    if error.outperforms_null is None:
        start = f"Too few pairs to judge how much {a} and {b} look alike in contact"
    elif not error.outperforms_null:
        start = f"In contact {a} looks no more like {b} than a picture without contact does"
    elif alike >= MIN_CLOSE_CORRELATION and error.mean <= MAX_CLOSE_ERROR * error.null:
        start = f"In contact {a} looks like {b}"
    else:
        start = f"In contact {a} resembles {b}, but is not close to it"
    floor = "" if math.isnan(error.floor) else f", noise alone by {error.floor:.1f}"
    picture = (
        f"they differ by {error.mean:.1f} grey levels, where no contact at all would differ by {error.null:.1f}"
        f"{floor}, and the change of colour correlates by {alike:.3f}"
    )
    normals, height = comparison.overall["gradient_angle"], comparison.overall["height_share"]
    surface = "" if math.isnan(normals.mean) else f"; normals are {normals.mean:.1f}° apart (flat: {normals.null:.1f}°)"
    surface += "" if math.isnan(height.mean) else f", heights {height.mean:.1%} of the indentation"
    return f"{start}: {picture}{surface}."

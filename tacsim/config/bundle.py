"""The bundle of a calibrated sensor as files: how it is found and checked, and the sensor model in it.

A bundle is a folder with `calibration.yaml` and `reference.png`, the picture without contact; `tacsim calibrate sensor`
writes it, and calibration.bundle reads the rest of it.
"""

from __future__ import annotations

import hashlib
import json
import stat
from pathlib import Path
from typing import Any

from tacsim.config.document import LoadState, Node, Place, display_path, node_of_data, parse_text, plain_data
from tacsim.models.text import suggest_word

FILE, REFERENCE = "calibration.yaml", "reference.png"
FORMAT = 8  # written and read
SENSORS_FOLDER = "sensors"  # folder of the user's sensors, next to the file that names them or in the current folder
REPLACE_ADVICE = "make it again with `tacsim calibrate sensor`"


class NoBundle(ValueError):
    """There is no complete bundle; the text gives the reason."""


def is_bundle(path: Path) -> bool:
    """Whether `path` is a folder with a calibration, or the file in it."""
    try:
        return (path / FILE).is_file() or (path.name == FILE and path.is_file())
    except (OSError, ValueError):
        return False


def find_bundle(reference: str | Path, folder: Path | None = None) -> Path:
    """The path of a bundle from a text in a file of `folder`: a path relative to `folder`, or the name of a bundle in
    its folder `sensors/`. Without `folder`, the current folder. A text without a bundle is a path."""
    here = Path.cwd() if folder is None else folder
    path, own = here / reference, here / SENSORS_FOLDER / reference
    return own if is_bundle(own) and not path.exists() else path


def user_sensor_names(folder: Path) -> list[str]:
    """Sorted names of the sensors in `sensors/` of a folder: bundles and YAML files."""
    try:
        entries = list((folder / SENSORS_FOLDER).iterdir())
    except OSError:
        return []
    return sorted({path.name if is_bundle(path) else path.stem for path in entries if _is_sensor(path)})


def _is_sensor(path: Path) -> bool:
    return is_bundle(path) or (path.suffix == ".yaml" and path.is_file())


def read_files(path: Path) -> tuple[Path, dict[str, Any], bytes]:
    """Path of the YAML file of a complete bundle (its folder or that file), its content, and the bytes of its picture.

    Raises NoBundle: files that are missing, too large or no files, another format, damage, changed content.
    """
    max_file_size, max_picture_size = 1_000_000, 1 << 26  # [bytes] of the YAML, and of the picture
    file = path
    try:
        file = path / FILE if path.is_dir() else path
        for part, limit in ((file, max_file_size), (file.with_name(REFERENCE), max_picture_size)):
            about = part.stat()
            if not stat.S_ISREG(about.st_mode):  # reading a pipe would block
                raise NoBundle(f"{part} is no file: a calibration is a folder with {FILE} and {REFERENCE}")
            if about.st_size > limit:
                raise NoBundle(f"{part}: {about.st_size} bytes is too much for a calibration; {REPLACE_ADVICE}")
        text = file.read_text(encoding="utf-8")
        png = file.with_name(REFERENCE).read_bytes()
    except FileNotFoundError as missing:
        raise NoBundle(
            f"{missing.filename} is not there: a calibration is a folder with {FILE} and {REFERENCE}"
            f"{_suggest_bundle(path)}"
        ) from None
    except (OSError, UnicodeDecodeError) as failure:
        raise NoBundle(f"{file}: cannot be read: {failure}") from failure
    state = LoadState()
    root = parse_text(text, display_path(file), file.parent, state)
    content = plain_data(root)
    version = content.get("format") if isinstance(content, dict) else None
    if version is not None and version != FORMAT:
        raise NoBundle(f"{file} has format {version}, this version of tacsim reads {FORMAT}; {REPLACE_ADVICE}")
    if state.problems:
        raise NoBundle(f"{file} is damaged; {REPLACE_ADVICE}. {'; '.join(map(str, state.problems))}")
    if version is None:
        raise NoBundle(f"{file} is no calibration: it names no format")
    return file, content, png


def require_unchanged(file: Path, content: dict[str, Any], png: bytes) -> None:
    """Raises NoBundle if the YAML file or the picture has changed since it was written."""
    if content.get("checksum") != bundle_digest(content):
        raise NoBundle(f"{file} was changed since it was written (its checksum differs); {REPLACE_ADVICE}")
    if hashlib.sha256(png).hexdigest() != content.get("reference"):
        raise NoBundle(f"{file.with_name(REFERENCE)} is not the picture of this calibration (its checksum differs)")


def bundle_digest(content: dict[str, Any]) -> str:
    """The value of `checksum`: SHA-256 of all other entries."""
    rest = {key: value for key, value in content.items() if key != "checksum"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def sensor_node(path: Path) -> Node:
    """The sensor model in a bundle, as the tree of a sensor file in `path`'s folder. Raises NoBundle."""
    file, content, png = read_files(path)
    require_unchanged(file, content, png)
    markers, origin = content.get("markers"), content.get("provenance")
    origin = origin if isinstance(origin, dict) else {}
    made, warnings = origin.get("made", ""), origin.get("warnings")
    model = {
        "name": content.get("serial"),
        "geometry": content.get("geometry"),
        "gel_size": content.get("gel_size"),
        "lighting": {"background": str(file.with_name(REFERENCE).resolve())},
        "photometric": content.get("forward"),
        "darkness": content.get("darkness"),
        "markers": {**markers, "in_background": True} if isinstance(markers, dict) else markers,
        "texture": 0.0,  # the picture contains the gel's texture
        "skin": content.get("skin") or 0.0,
        "noise": content.get("noise"),
        "view": content.get("view"),
        "source": f"calibration of {content.get('serial')}, {made}",
        "caution": next((words for words in warnings if _is_verdict_warning(words)), "")
        if isinstance(warnings, list)
        else "",
    }
    return node_of_data(model, Place(display_path(file), 1), file.parent)


def _is_verdict_warning(warning: object) -> bool:
    """Whether a warning in a bundle is the verdict "do not trust"."""
    return isinstance(warning, str) and warning.startswith("verdict: do not trust")


def _suggest_bundle(path: Path) -> str:
    """A hint to a bundle with a similar name, if `path` does not exist."""
    if path.exists():
        return ""
    folder = path.parent
    try:
        names = [each.name for each in folder.iterdir() if is_bundle(each)]
    except OSError:
        names = []
    return suggest_word(path.name, [*names, *(user_sensor_names(folder) if folder.name != SENSORS_FOLDER else [])])

"""The bundle of a calibrated sensor as a file: where it is found, whether it is whole, and the sensor model in it.

A bundle is a folder with `calibration.yaml` and `reference.png`, the picture without contact; `tacsim calibrate sensor`
writes it, and calibration.bundle reads the rest of it.
"""

from __future__ import annotations

import hashlib
import json
import stat
from pathlib import Path
from typing import Any

from tacsim.config.document import LoadState, Node, from_plain, parse_text, plain, shown
from tacsim.config.errors import Place, did_you_mean

FILE, REFERENCE = "calibration.yaml", "reference.png"
FORMAT = 8  # that is written and read
OWN = "sensors"  # folder of sensors of one's own, beside the file that names them or in the current folder
AGAIN = "make it again with `tacsim calibrate sensor`"


class NoBundle(ValueError):
    """There is no whole bundle; the text says why."""


def is_bundle(path: Path) -> bool:
    """A folder with a calibration, or the file in it."""
    try:
        return (path / FILE).is_file() or (path.name == FILE and path.is_file())
    except (OSError, ValueError):
        return False


def find_bundle(reference: str | Path, folder: Path | None = None) -> Path:
    """The path that a text in a file of `folder` means: a path from there, or the name of a bundle in `sensors/` there.
    Without `folder`, from the current one. What is not there stays a path."""
    here = Path.cwd() if folder is None else folder
    path, own = here / reference, here / OWN / reference
    return own if is_bundle(own) and not path.exists() else path


def own_names(folder: Path) -> list[str]:
    """Sorted names of the sensors in `sensors/` of a folder: bundles and YAML files."""
    try:
        there = list((folder / OWN).iterdir())
    except OSError:
        return []
    return sorted({path.name if is_bundle(path) else path.stem for path in there if _is_sensor(path)})


def _is_sensor(path: Path) -> bool:
    return is_bundle(path) or (path.suffix == ".yaml" and path.is_file())


def read_files(path: Path) -> tuple[Path, dict[str, Any], bytes]:
    """Path of the YAML file of a whole bundle (its folder or that file), its content, and the bytes of its picture.

    Raises NoBundle: files that are missing, too large or no files, another format, damage, changed content.
    """
    max_file_size, max_picture_size = 1_000_000, 1 << 26  # [bytes] of the YAML, and of the picture
    file = path
    try:
        file = path / FILE if path.is_dir() else path
        for part, most in ((file, max_file_size), (file.with_name(REFERENCE), max_picture_size)):
            about = part.stat()
            if not stat.S_ISREG(about.st_mode):  # a pipe would be waited for
                raise NoBundle(f"{part} is no file: a calibration is a folder with {FILE} and {REFERENCE}")
            if about.st_size > most:
                raise NoBundle(f"{part}: {about.st_size} bytes is too much for a calibration; {AGAIN}")
        text = file.read_text(encoding="utf-8")
        png = file.with_name(REFERENCE).read_bytes()
    except FileNotFoundError as missing:
        raise NoBundle(
            f"{missing.filename} is not there: a calibration is a folder with {FILE} and {REFERENCE}{_beside(path)}"
        ) from None
    except (OSError, UnicodeDecodeError) as failure:
        raise NoBundle(f"{file}: cannot be read: {failure}") from failure
    state = LoadState()
    root = parse_text(text, shown(file), file.parent, state)
    content = plain(root)
    version = content.get("format") if isinstance(content, dict) else None
    if version is not None and version != FORMAT:
        raise NoBundle(f"{file} has format {version}, this version of tacsim reads {FORMAT}; {AGAIN}")
    if state.problems:
        raise NoBundle(f"{file} is damaged; {AGAIN}. {'; '.join(map(str, state.problems))}")
    if version is None:
        raise NoBundle(f"{file} is no calibration: it names no format")
    return file, content, png


def require_unchanged(file: Path, content: dict[str, Any], png: bytes) -> None:
    """Raises NoBundle where the YAML file or the picture is not what was written."""
    if content.get("checksum") != digest(content):
        raise NoBundle(f"{file} was changed since it was written (its checksum differs); {AGAIN}")
    if hashlib.sha256(png).hexdigest() != content.get("reference"):
        raise NoBundle(f"{file.with_name(REFERENCE)} is not the picture of this calibration (its checksum differs)")


def digest(content: dict[str, Any]) -> str:
    """What `checksum` must be: SHA-256 of all the rest."""
    rest = {key: value for key, value in content.items() if key != "checksum"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def sensor_node(path: Path) -> Node:
    """The sensor model in a bundle, as a tree that a file of `path`'s folder could have said. Raises NoBundle."""
    file, content, png = read_files(path)
    require_unchanged(file, content, png)
    markers, origin = content.get("markers"), content.get("provenance")
    origin = origin if isinstance(origin, dict) else {}
    made, told = origin.get("made", ""), origin.get("warnings")
    model = {
        "name": content.get("serial"),
        "geometry": content.get("geometry"),
        "gel_size": content.get("gel_size"),
        "lighting": {"background": str(file.with_name(REFERENCE).resolve())},
        "photometric": content.get("forward"),
        "darkness": content.get("darkness"),
        "markers": {**markers, "in_background": True} if isinstance(markers, dict) else markers,
        "texture": 0.0,  # the picture has the gel's own
        "skin": content.get("skin") or 0.0,
        "noise": content.get("noise"),
        "view": content.get("view"),
        "source": f"calibration of {content.get('serial')}, {made}",
        "caution": next((words for words in told if _distrusts(words)), "") if isinstance(told, list) else "",
    }
    return from_plain(model, Place(shown(file), 1), file.parent)


def _distrusts(warning: object) -> bool:
    """A warning in a bundle is the verdict that it is not to be trusted."""
    return isinstance(warning, str) and warning.startswith("verdict: do not trust")


def _beside(path: Path) -> str:
    """A word on a bundle of nearly that name, where `path` itself is not there."""
    if path.exists():
        return ""
    folder = path.parent
    try:
        names = [each.name for each in folder.iterdir() if is_bundle(each)]
    except OSError:
        names = []
    return did_you_mean(path.name, [*names, *(own_names(folder) if folder.name != OWN else [])])

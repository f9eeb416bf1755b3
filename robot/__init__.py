"""Hardware, mocks, calibration procedures and the command line: what stands above `tacsim` and `calibration`."""

from importlib.util import find_spec
from pathlib import Path


def _require_own_packages() -> None:
    """Raises ImportError where a file or folder of the same name would be imported in place of one of our packages: a
    script's own folder stands before the installed packages on Python's path."""
    here = Path(__file__).resolve().parent.parent
    for package in ("tacsim", "calibration"):
        spec = find_spec(package)
        found = None if spec is None or spec.origin is None else Path(spec.origin).resolve()
        if found != here / package / "__init__.py":
            raise ImportError(
                f"'{package}' is {found}, not the package of tacsim at {here}: rename yours, or run from another folder"
            )


_require_own_packages()

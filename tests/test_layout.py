"""The house rules that a machine can check: who imports what, what a light import loads, what the wheel carries."""

from __future__ import annotations

import ast
import importlib
import json
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("tacsim", "calibration", "robot")  # each imports only itself and those before it
HEAVY = {"taichi", "cv2", "mujoco", "rtde_control", "rtde_receive", "rtde_io", "dashboard_client", "script_client"}
LIGHT_IMPORTS = (
    *(*PACKAGES, "tacsim.interface", "tacsim.config", "tacsim.record.replay", "tacsim.geometry.shapes"),
    *(
        "tacsim.gym.env",
        "tacsim.sim.reset",
        "robot.open",
        "robot.deploy.control_loop",
        "robot.deploy.policy",
        "robot.cli",
    ),
)
# Of 12 parameters and more. Taichi's graphs, which launch kernels of a device, take no argument packs.
LONG_SIGNATURES = {
    "tacsim/physics/seed/kernels.py advance",
    "tacsim/physics/worlds/device.py press_substep",
    "tacsim/physics/worlds/device.py scatter_of_hybrid",
    "tacsim/rig.py __init__",
}
API: dict[str, list[str]] = json.loads((ROOT / "tests/api_surface.json").read_text(encoding="utf-8"))
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
TREES = {path: ast.parse(path.read_text(encoding="utf-8"), str(path)) for path in MODULES}
BENCHMARKS = {  # of the checkout alone: the wheel does not carry them
    path: ast.parse(path.read_text(encoding="utf-8"), str(path)) for path in (ROOT / "benchmarks").rglob("*.py")
}

TEXT = {".py", ".md", ".toml", ".yaml", ".yml", ".txt", ".json", ".jinja", ".html", ".css", ".cfg", ".ini", ""}
SHIPPED = (*PACKAGES, "configs", "constraints", "docs", "examples", "benchmarks", "tests", "tools", ".ci")
SHIPPED = (*PACKAGES, "configs", "constraints", "docs", "examples", "benchmarks", "tests", ".ci", ".github")
# Spelled in pieces, so that this file does not find itself.
MACHINE_PATHS = re.compile(
    "|".join((r"\.\./" + "shared", r"(?<![\w.])/" + "work/", r"(?<![\w.])/" + "root/", "file:" + "//"))
)


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def imports(tree: ast.AST) -> Iterator[str]:
    """Full names of the modules that `tree` imports, wherever in it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            yield node.module


def loaded_on_import(tree: ast.Module) -> Iterator[str]:
    """Full names of the modules imported when the file itself is: outside functions and `if TYPE_CHECKING`."""
    waiting: list[ast.AST] = list(tree.body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            waiting += node.orelse
            continue
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield from imports(node)
        waiting += ast.iter_child_nodes(node)


def top(module: str) -> str:
    return module.partition(".")[0]


def has_kernels(tree: ast.Module) -> bool:
    """True if a function is decorated with something of `ti` (@ti.kernel, @ti.func, ...)."""
    return any(
        re.match(r"ti\.", ast.unparse(decorator))
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.ClassDef)
        for decorator in node.decorator_list
    )


def shipped_texts() -> Iterator[Path]:
    """Text files of the project: those of the known folders and of its root, without caches."""
    for path in (*ROOT.iterdir(), *(path for folder in SHIPPED for path in (ROOT / folder).rglob("*"))):
        if path.is_file() and path.suffix in TEXT and "__pycache__" not in path.parts and path.name != ".git":
            yield path


LIGHT_PROGRAM = f"""
import importlib, sys
for module in {LIGHT_IMPORTS!r}:
    importlib.import_module(module)
    loaded = {{name.partition(".")[0] for name in sys.modules}} & {HEAVY | {"trimesh", "PIL"}!r}
    assert not loaded, f"`import {{module}}` loads {{loaded}}: import it inside the function"
drivers = sys.modules.get("tacsim.models.driver")
assert drivers is None or not drivers.installed_drivers.cache_info().currsize, "drivers are looked up on import"
sys.modules["tacsim.config"].load_rig("sim")
assert not {{"taichi", "cv2"}} & set(sys.modules)
"""


def test_importing_is_light() -> None:
    done = subprocess.run([sys.executable, "-c", LIGHT_PROGRAM], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_a_press_and_an_environment_are_ready_without_scipy_and_matplotlib() -> None:
    """They take as long to import as a press takes."""
    program = """
import sys
import robot.studies.press, robot.rig.sim_env
from tacsim.physics.world import make_world
from tacsim.config import load_scene
loaded = {"scipy", "matplotlib", "pandas"} & {name.partition(".")[0] for name in sys.modules}
make_world(load_scene("squeeze", ["preset=draft"])).surface("lower")
assert not loaded | ({"scipy"} & set(sys.modules)), loaded
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("package", API)
def test_public_names_are_those_of_the_list(package: str) -> None:
    """A name leaves tests/api_surface.json only with a line in CHANGELOG.md."""
    module = importlib.import_module(package)
    assert sorted(module.__all__) == API[package]
    for public in API[package]:
        assert getattr(module, public) is not None
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nothing'"):
        module.nothing  # noqa: B018


def test_opencv_and_ur_rtde_are_imported_inside_functions() -> None:
    found = {
        name(path): sorted(heavy)
        for path, tree in TREES.items()
        if (heavy := (HEAVY - {"taichi"}) & set(map(top, loaded_on_import(tree))))
    }
    assert found == {}


def test_kernel_files_keep_their_annotations() -> None:
    """Taichi reads annotations of kernels as objects; `from __future__ import annotations` makes them strings."""
    trees = TREES | BENCHMARKS
    assert [name(path) for path, tree in trees.items() if has_kernels(tree) and "__future__" in imports(tree)] == []


def test_mypy_spares_kernel_files_and_no_other() -> None:
    overrides = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["mypy"]["overrides"]
    (spared,) = (item["module"] for item in overrides if item.get("check_untyped_defs") is False)
    kernels = {path for path, tree in (TREES | BENCHMARKS).items() if has_kernels(tree)}
    assert set(spared) == {name(path).removesuffix(".py").replace("/", ".") for path in kernels}


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    arguments = function.args
    named = len(arguments.posonlyargs) + len(arguments.args) + len(arguments.kwonlyargs)
    return named + (arguments.vararg is not None) + (arguments.kwarg is not None)


def test_only_listed_functions_have_twelve_parameters_or_more() -> None:
    found = {
        f"{name(path)} {node.name}"
        for path, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and parameters(node) >= 12
    }
    assert found == LONG_SIGNATURES and len(LONG_SIGNATURES) <= 5


def test_no_package_imports_the_benchmarks() -> None:
    """They import the packages; `tacsim bench` finds them by name (robot/cli/bench.py)."""
    assert [name(path) for path, tree in TREES.items() if "benchmarks" in map(top, imports(tree))] == []


def test_every_folder_of_modules_is_a_package() -> None:
    folders = {path.parent for path in MODULES}
    assert [name(folder) for folder in sorted(folders) if not (folder / "__init__.py").is_file()] == []
    assert [package for package in PACKAGES if not (ROOT / package / "py.typed").is_file()] == []


def test_tests_mirror_the_packages() -> None:
    """A folder below tests/<package> is named after the one it tests."""
    folders = {path.parent for package in PACKAGES for path in (ROOT / "tests" / package).rglob("test_*.py")}
    assert [
        name(folder) for folder in sorted(folders) if not (ROOT / folder.relative_to(ROOT / "tests")).is_dir()
    ] == []


def test_no_text_names_a_place_on_somebodys_machine() -> None:
    found = [
        f"{name(path)}:{number}"
        for path in shipped_texts()
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if MACHINE_PATHS.search(line)
    ]
    assert found == []


@pytest.mark.parametrize("version", ["311", "312", "313"])
def test_constraints_are_pins_and_nothing_else(version: str) -> None:
    lines = (ROOT / f"constraints/py{version}.txt").read_text(encoding="utf-8").splitlines()
    pins = [line for line in lines if not line.startswith("#")]
    assert [line for line in pins if not re.fullmatch(r"[a-z0-9-]+==[\w.+!]+", line)] == []
    required = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = {
        re.split(r"[^\w-]", requirement)[0].lower()
        for requirement in (*required["dependencies"], *required["optional-dependencies"]["dev"])
    }
    if version == "313":
        wanted.remove("ur-rtde")  # has no wheel there
    assert wanted <= {line.partition("==")[0] for line in pins}, "pyproject.toml changed: run `make lock`"


def build(target: str, root: Path, folder: Path) -> Path:
    """A distribution of the sources at `root`, built in `folder` without the network."""
    command = [sys.executable, "-m", "hatchling", "build", "--target", target, "--directory", str(folder)]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    (made,) = folder.iterdir()
    return made


def contents(wheel: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.mark.slow
def test_the_wheel_of_the_sdist_is_that_of_the_checkout(tmp_path: Path) -> None:
    """As `python -m build` and pip make it: from the sdist, unpacked, and from nothing else."""
    sdist = build("sdist", ROOT, tmp_path / "sdist")
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path / "unpacked", filter="data")
    (unpacked,) = (tmp_path / "unpacked").iterdir()
    from_sdist = contents(build("wheel", unpacked, tmp_path / "wheel"))
    assert from_sdist == contents(build("wheel", ROOT, tmp_path / "of_checkout"))
    assert [name for name in from_sdist if name.endswith(".pth")] == []


def test_wheel_carries_packages_and_configs(tmp_path: Path) -> None:
    carried = set(contents(build("wheel", ROOT, tmp_path / "wheel")))
    configs = {path.relative_to(ROOT / "configs").as_posix() for path in (ROOT / "configs").rglob("*.yaml")}
    assert configs, "configs/ holds no YAML file"
    assert {f"tacsim/_configs/{config}" for config in configs} <= carried
    assert {name(path) for path in MODULES} <= carried
    assert {f"{package}/py.typed" for package in PACKAGES} <= carried
    assert [entry for entry in carried if "benchmarks" in entry] == []
    assert "robot/cli/bench.py" in carried  # which says where they are
    assert {top(entry.partition("/")[0]) for entry in carried} == {
        *PACKAGES,
        "pytest_tacsim",  # a module by itself: sessions that it is not for import no package
        "tacsim-0",  # tacsim-0.1.0.dist-info
    }

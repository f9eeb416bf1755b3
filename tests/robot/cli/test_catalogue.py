"""`tacsim list`, `show` and `new`: everything that is shipped can be found, printed and copied."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from tacsim.config import config_root, load_rig, load_scene, load_sensor
from tacsim.config.kinds import CATALOGUE_KINDS
from tests.robot.cli.invoked import plain_text, tacsim

pytestmark = pytest.mark.usefixtures("empty_folder")


def rows(*words: str) -> list[dict[str, str]]:
    done = tacsim("list", *words, "--json")
    assert done.exit_code == 0, done.output
    return list(json.loads(done.stdout))


def test_list_names_every_shipped_file_with_a_summary() -> None:
    files = {path for path in config_root().rglob("*") if path.suffix in (".yaml", ".onnx")}
    found = rows()
    assert {Path(each["path"]) for each in found if each["kind"] != "driver"} == files
    assert {each["kind"] for each in found} == set(CATALOGUE_KINDS)
    assert all(len(each["summary"]) > 10 for each in found)
    assert {"arm.ur", "arm.sim", "sensor.camera", "sensor.replay"} <= {each["name"] for each in rows("driver")}


@pytest.mark.parametrize(("plural", "kind"), [("rigs", "rig"), ("policies", "policy")])
def test_a_kind_may_be_a_plural(plural: str, kind: str) -> None:
    assert rows(plural) == rows(kind) != []


def test_list_prints_a_table_of_one_kind() -> None:
    done = tacsim("list", "sensor")
    assert "gelsight-mini" in done.stdout and "ur5e" not in done.stdout and "┃" not in done.stdout


@pytest.mark.parametrize("name", ["ur5e-one", "digit", "arm.ur", "modelling-clay"])
def test_show_prints_what_a_name_stands_for(name: str) -> None:
    done = tacsim("show", name)
    assert done.exit_code == 0, done.output
    (entry,) = [each for each in rows() if each["name"] == name]
    assert entry["path"] in done.stdout
    if entry["kind"] == "driver":
        assert "host" in done.stdout and "required" in done.stdout
    else:
        assert Path(entry["path"]).read_text(encoding="utf-8").rstrip() in done.stdout


def test_show_prints_all_kinds_of_a_name_or_the_chosen_one() -> None:
    kinds = [each["kind"] for each in json.loads(tacsim("show", "squeeze", "--json").stdout)]
    assert kinds == ["task", "scene", "randomisation", "training", "benchmark", "policy"]
    (policy,) = json.loads(tacsim("show", "squeeze", "--kind", "policy", "--json").stdout)
    assert policy["task"] == "squeeze" and policy["inputs"] and policy["axes"]


def test_show_needs_no_package_for_kinds_that_need_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    done = tacsim("show", "squeeze")
    assert done.exit_code == 0
    assert "task squeeze" in done.stdout and "goal" in done.stdout
    assert "pip install 'tacsim[policy]'" in plain_text(done.stdout)
    assert tacsim("show", "squeeze", "--kind", "policy").exit_code == 2


def test_show_unknown_name_suggests_the_nearest() -> None:
    done = tacsim("show", "gelsight-min")
    assert done.exit_code == 2
    assert "nothing is called 'gelsight-min'; did you mean 'gelsight-mini'?; `tacsim list` prints" in done.stderr


@pytest.mark.parametrize(
    ("kind", "source", "load"),
    [("rig", "mock", load_rig), ("scene", "press", load_scene), ("sensor", "digit", load_sensor)],
)
def test_new_writes_a_copy_that_loads(tmp_path: Path, kind: str, source: str, load: object) -> None:
    done = tacsim("new", kind, "mine", "--from", source)
    assert done.exit_code == 0, done.output
    assert callable(load)
    load(tmp_path / "mine.yaml")
    assert "name: mine" in (tmp_path / "mine.yaml").read_text(encoding="utf-8")
    again = tacsim("new", kind, "mine")
    assert again.exit_code == 2 and "mine.yaml: exists already" in again.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("rig", "../up"), "'../up' is no name"),
        (("rig", "mine", "--from", "mok"), "no rig 'mok'; allowed: "),
        (("rig", "mine", "--out", "mine.txt"), "mine.txt must end in .yaml"),
        (("driver", "1st"), "'1st' cannot be a Python package"),
        (("driver", "class"), "'class' cannot be a Python package"),
        (("driver", "mine", "--from", "sim"), "a driver is made of one template"),
        (("policy", "mine"), "Invalid value for"),
    ],
)
def test_new_refuses_what_it_cannot_make(tmp_path: Path, words: tuple[str, ...], said: str) -> None:
    done = tacsim("new", *words)
    assert done.exit_code == 2 and said in " ".join(done.stderr.replace("│", " ").split())
    assert not any(tmp_path.iterdir())


def test_new_driver_overwrites_no_folder(tmp_path: Path) -> None:
    assert tacsim("new", "driver", "my-skin").exit_code == 0
    made = {path.relative_to(tmp_path).as_posix() for path in (tmp_path / "my-skin").rglob("*") if path.is_file()}
    package = {f"my-skin/my_skin/{name}.py" for name in ("__init__", "arm", "sensor")}
    assert made == package | {"my-skin/pyproject.toml", "my-skin/README.md", "my-skin/rig.yaml"}
    for path in made:
        assert "{{" not in (tmp_path / path).read_text(encoding="utf-8")
    again = tacsim("new", "driver", "my-skin")
    assert again.exit_code == 2 and "exists already" in again.stderr

"""Commands that tell what there is, and that write a first file: `tacsim list`, `tacsim show`, `tacsim new`."""

from __future__ import annotations

import keyword
import re
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import typer

from robot.cli.options import complete_names
from robot.cli.output import notes, print_files, print_json, results, show_table, writing

Kind = Literal[
    "rig", "task", "scene", "sensor", "randomisation", "training", "benchmark", "material", "policy", "driver"
]  # tacsim.config.kinds.CATALOGUE_KINDS, without importing it for each command


def parse_kind(text: str) -> str:
    """A kind, also from its plural. Raises typer.BadParameter."""
    kinds = get_args(Kind)
    singular = f"{text[:-3]}y" if text.endswith("ies") else text.removesuffix("s")
    for word in (text, singular):
        if word in kinds:
            return word
    raise typer.BadParameter(f"'{text}' is not one of {', '.join(map(repr, kinds))}")


def list_(
    kind: Annotated[
        str | None,
        typer.Argument(
            parser=parse_kind,
            metavar="KIND",
            help=f"{', '.join(get_args(Kind))}; all of them if left out.",
            show_default=False,
            autocompletion=complete_names(words=get_args(Kind)),
        ),
    ] = None,
) -> None:
    """List what is shipped or installed by name: rigs, tasks, scenes, sensors, materials, policies, drivers.

    Example: tacsim list rig
    """
    from tacsim.config.kinds import CATALOGUE_KINDS, list_entries

    entries = [entry for each in ([kind] if kind else CATALOGUE_KINDS) for entry in list_entries(each)]
    print_json(
        [{"kind": each.kind, "name": each.name, "summary": each.summary, "path": _text(each.path)} for each in entries]
    )
    show_table("", ("kind", "name", ""), [(each.kind, each.name, each.summary) for each in entries], left=(0, 1, 2))
    notes.print("tacsim show NAME prints one of them; the path of a file may stand for each name, except a driver's")


def show(
    name: Annotated[
        str,
        typer.Argument(help="A name that tacsim list prints.", autocompletion=complete_names(*get_args(Kind))),
    ],
    kind: Annotated[Kind | None, typer.Option(help="Where several kinds have that name.", show_default=False)] = None,
) -> None:
    """Print what a name stands for: the file of a rig, task, sensor ..., the fields of a driver, a policy's inputs.

    Example: tacsim show gelsight-mini
    """
    from tacsim.config.kinds import find_entries

    found = find_entries(name, kind)
    described = [
        {"kind": each.kind, "name": each.name, "path": _text(each.path), **_describe(each, is_alone=len(found) == 1)}
        for each in found
    ]
    print_json(described)
    for number, each in enumerate(described):
        if number:
            results.print("")
        results.print(f"{each.pop('kind')} {each.pop('name')}  {each.pop('path') or ''}".rstrip())
        text = each.pop("text", None)
        for key, value in each.items():
            results.print(f"  {key:24} {_compact(value)}")
        if text is not None:
            results.print(text.rstrip())
    if len(described) > 1:
        notes.print("several kinds have this name; --kind chooses one")


def _compact(value: Any) -> str:
    """A value on one line: of nested values only those that are set."""
    if isinstance(value, dict):
        return ", ".join(f"{key} {_compact(each)}" for key, each in value.items() if each not in (None, {}, [], ()))
    return ", ".join(map(_compact, value)) if isinstance(value, list) else str(value)


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)


def _describe(entry: Any, *, is_alone: bool) -> dict[str, Any]:
    """What is printed of an entry after its name: the text of its file, or its fields in words.

    Raises PolicyNotFound for a policy that cannot be read and is alone; among others it is only described as such.
    """
    from tacsim.config.kinds import DRIVER, POLICY

    if entry.kind == POLICY:
        from robot.deploy.python_policy import PolicyNotFound

        try:
            return _describe_policy(entry.path)
        except PolicyNotFound as failure:
            if is_alone:
                raise
            return {"not read": str(failure)}
    if entry.kind == DRIVER:
        return _describe_driver(entry.name)
    return {"text": entry.path.read_text("utf-8")}


def _describe_policy(path: Path) -> dict[str, Any]:
    from robot.deploy.onnx_policy import read_policy_spec
    from tacsim.models.policy import ActionAxis

    spec = read_policy_spec(path)
    scene = {} if spec.range is None else spec.range.scene
    return {
        "sha256": sha256(path.read_bytes()).hexdigest(),
        "task": spec.task,
        "period": f"{spec.period:g} s",
        "inputs": {key: list(numbers.names) for key, numbers in spec.inputs.items()},
        "axes": [
            f"{axis.arm} {list(axis.direction)}"
            if isinstance(axis, ActionAxis)
            else f"{axis.gripper} {axis.min_force:g} to {axis.max_force:g} N"
            for axis in spec.axes
        ],
        "max_step": f"{spec.max_step * 1e3:g} mm",
        "trained": spec.trained,  # settings of `tacsim train`
        "training range": "recorded" if spec.range is not None else "unknown",
        "scenes of training": {key: f"{low:g} to {high:g}" for key, (low, high) in scene.items()},  # [SI]
    }


def _describe_driver(name: str) -> dict[str, Any]:
    from tacsim.models.driver import installed_drivers

    kind, _, short = name.partition(".")
    drivers = installed_drivers()
    if short in drivers.refused[kind]:
        return {"refused": drivers.refused[kind][short]}
    config = drivers.usable[kind][short].config_class
    return {key: _describe_field(field) for key, field in config.model_fields.items()}


def _describe_field(field: Any) -> str:
    kind = getattr(field.annotation, "__name__", str(field.annotation))
    return (
        f"{kind}, required"
        if field.is_required()
        else f"{kind}, default {field.get_default(call_default_factory=True)!r}"
    )


def new(
    kind: Annotated[
        Literal["rig", "task", "scene", "sensor", "randomisation", "training", "material", "driver"],
        typer.Argument(help="What to begin."),
    ],
    name: Annotated[str, typer.Argument(help="Its name: letters, digits, - and _.")],
    source: Annotated[
        str | None,
        typer.Option(
            "--from",
            help="The shipped file to copy (tacsim list KIND).",
            show_default="one of that kind",
            autocompletion=complete_names(*get_args(Kind)),
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="The new file; of a driver the new folder.", show_default="NAME")
    ] = None,
) -> None:
    """Write a new file as a copy of a shipped one, or a driver as a small distribution that works.

    Example: tacsim new rig my-cell --from ur5e-one
    """
    from tacsim.config.kinds import is_name

    if not is_name(name):
        raise typer.BadParameter(f"'{name}' is no name; use letters, digits, - and _", param_hint="NAME")
    if kind == "driver":
        if source is not None:
            raise typer.BadParameter("a driver is made of one template; leave it out", param_hint="--from")
        _new_driver(name, Path(name) if out is None else out)
        return
    from tacsim.config.kinds import KINDS, shipped_file

    defaults = {"rig": "sim", "task": "squeeze", "scene": "squeeze", "sensor": "ideal", "material": "modelling-clay"}
    path = shipped_file(KINDS[kind], source or defaults.get(kind, "squeeze"))
    file = Path(f"{name}.yaml") if out is None else out
    if file.suffix not in (".yaml", ".yml"):
        raise typer.BadParameter(f"{file} must end in .yaml", param_hint="--out")
    text = re.sub(r"^name: .*$", f"name: {name}", path.read_text("utf-8"), count=1, flags=re.MULTILINE)
    with writing(file.parent), file.open("x", encoding="utf-8") as opened:
        opened.write(text)
    notes.print(f"a copy of the shipped {kind} {path.stem}; use its path wherever a name of a {kind} stands")
    print_files(file)
    print_json({}, [file])


def _new_driver(name: str, folder: Path) -> None:
    """Writes the distribution of `configs/templates/driver` with its names replaced."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    from tacsim.config.kinds import config_root

    package = name.lower().replace("-", "_")
    if not package.isidentifier() or keyword.iskeyword(package):
        raise typer.BadParameter(f"'{name}' cannot be a Python package; begin with a letter", param_hint="NAME")
    templates = config_root() / "templates" / "driver"
    pages = Environment(loader=FileSystemLoader(templates), undefined=StrictUndefined, keep_trailing_newline=True)
    files = {
        folder / path.relative_to(templates).as_posix().replace("PACKAGE", package).removesuffix(".jinja"): path
        for path in sorted(templates.rglob("*.jinja"))
    }
    with writing(folder, new=True):
        for file, template in files.items():
            file.parent.mkdir(parents=True, exist_ok=True)
            page = pages.get_template(template.relative_to(templates).as_posix())
            file.write_text(page.render(name=name.lower(), package=package), encoding="utf-8")
    notes.print(f"install it: pip install -e {folder}; then run it: tacsim run {folder / 'rig.yaml'} --policy grip")
    print_files(*files)
    print_json({}, list(files))

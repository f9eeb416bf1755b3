"""JSON schema of the configuration files, for editors."""

from __future__ import annotations

from typing import Any

from pydantic import TypeAdapter
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from tacsim.config.kinds import KINDS, kind_of, names


def json_schema(kind: str = "rig") -> dict[str, Any]:
    """The JSON schema of a kind of file (rig, task, scene, sensor, material), string references and units included.

    For completion and checks while you type, write it to a file and name that in the first line of the YAML file; any
    editor with yaml-language-server (VS Code's YAML extension, Neovim, Emacs, JetBrains) understands::

        tacsim schema rig > rig.schema.json
        # yaml-language-server: $schema=rig.schema.json

    Raises KeyError on another kind.
    """
    schema = TypeAdapter(KINDS[kind].annotation).json_schema(schema_generator=_Generator, mode="validation")
    schema["$schema"] = _Generator.schema_dialect
    schema["title"] = f"tacsim {kind}"
    return schema


class _Generator(GenerateJsonSchema):
    """Adds what the loader accepts besides a mapping: the name of a file, and ``extends``."""

    def model_schema(self, schema: core_schema.ModelSchema) -> JsonSchemaValue:
        mapping = super().model_schema(schema)
        kind = kind_of([schema["cls"]])
        if kind is None:
            return mapping
        reference = {
            "description": f"name of a {kind.name}, or path of a .yaml file below this folder",
            "anyOf": [{"enum": names(kind.name)}, {"type": "string", "pattern": r"\.ya?ml$"}],
        }
        mapping["properties"]["extends"] = {
            **reference,
            "description": f"{reference['description']}, to change a few keys of",
        }
        required = mapping.pop("required", [])
        if required:
            mapping["anyOf"] = [{"required": required}, {"required": ["extends"]}]
        return {"anyOf": [reference, mapping]}

    def tagged_union_schema(self, schema: core_schema.TaggedUnionSchema) -> JsonSchemaValue:
        union = super().tagged_union_schema(schema)
        union.pop("discriminator", None)  # a keyword of OpenAPI, not of JSON schema
        union["anyOf"] = union.pop("oneOf")  # a reference by name fits every variant
        return union

"""An extension of griffe, which reads the code for mkdocstrings: fields without a docstring get their comment."""

from __future__ import annotations

import ast
from typing import Any

import griffe

from tools.site.comments import comments_of_fields


class FieldDescriptions(griffe.Extension):
    """Gives each field the comment next to it as its description."""

    def on_class_members(self, *, node: ast.AST | griffe.ObjectNode, cls: griffe.Class, **_: Any) -> None:
        """Called for each class that griffe has read."""
        if not isinstance(node, ast.ClassDef) or not cls.source:
            return
        for name, words in comments_of_fields(cls.source).items():
            member = cls.members.get(name)
            if words and isinstance(member, griffe.Attribute) and member.docstring is None:
                member.docstring = griffe.Docstring(words, parent=member)

"""Fields of dataclasses that are made when they are first read."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

FieldValue = TypeVar("FieldValue")


class LazyField(Generic[FieldValue]):
    """A field of a dataclass, given as it is or as a function that makes it, called when the field is first looked at:
    a picture is rendered only where it is read."""

    def __init__(self, *default: FieldValue) -> None:
        self._default = default

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, instance: object | None, owner: type | None = None) -> FieldValue:
        if instance is None:  # `dataclass` asks for the default so, and takes this error for none
            if not self._default:
                raise AttributeError(self._name)
            return self._default[0]
        value: Any = instance.__dict__[self._name]
        if callable(value):
            value = instance.__dict__[self._name] = value()
        return value  # type: ignore[no-any-return]

    def __set__(self, instance: object, value: FieldValue | Callable[[], FieldValue]) -> None:
        instance.__dict__[self._name] = value


class LazyFields:
    """A dataclass whose fields `LazyField` are made before it is copied or sent to another process."""

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self.__dict__}

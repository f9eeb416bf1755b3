"""Names that drivers and mocks share, so that neither imports the other."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Self

MOCK_SERIAL = "00000000001"  # of mock controllers; no real arm has this number, so a driver recognises a mock


class Closing(ABC):
    """A context manager that closes itself at the end of its block."""

    @abstractmethod
    def close(self) -> None: ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

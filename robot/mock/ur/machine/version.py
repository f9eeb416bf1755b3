"""The version of PolyScope that a mock reports."""

from __future__ import annotations

import re
from collections.abc import Sequence

Version = tuple[int, int, int, int]  # major, minor, bugfix, build

VERSION: Version = (5, 11, 0, 108150)


def check_version(numbers: Sequence[float]) -> Version:
    """Checks that a version is four integers that the RTDE can send. Raises ValueError."""
    max_number = 2**32 - 1  # the RTDE sends each as a uint32
    if len(numbers) != 4 or not all(0 <= number <= max_number and number == int(number) for number in numbers):
        raise ValueError(f"a version is four whole numbers from 0 to {max_number}, got {list(numbers)}")
    major, minor, bugfix, build = map(int, numbers)
    return major, minor, bugfix, build


def version_text(version: Version) -> str:
    """Text such as 5.11.0.108150."""
    return ".".join(map(str, version))


def parse_version(text: str) -> Version:
    """Parses "5.11", "5.11.0" or "5.11.0.108150"; missing numbers are 0. Raises ValueError."""
    if re.fullmatch(r"\d{1,10}(\.\d{1,10}){1,3}", text, re.ASCII) is None:
        raise ValueError(f"a version of PolyScope is like 5.11 or 5.11.0.108150, got '{text[:40]}'")
    numbers = [int(number) for number in text.split(".")]
    return check_version([*numbers, *[0] * (4 - len(numbers))])

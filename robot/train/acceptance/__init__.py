"""Acceptance of a policy in a test session: `pytest --policy mine.onnx --task squeeze` (docs/acceptance.md).

A sequential test on the frozen episodes of the benchmark ends as soon as they decide.
"""

"""Rerun converts an episode by itself: nothing in it is left as bytes, save what is attached."""

from __future__ import annotations

from collections.abc import Callable
from importlib import util
from pathlib import Path

import pytest

from tacsim.record.episode import EpisodeMeta, Step
from tacsim.record.writer import Recorder

# Entity: a column that a viewer draws or plots. What rigs of each kind record: surfaces with and without flow, pictures
# alone, arms with and without joints, packages of UR controllers.
DRAWN = {
    "/lower/image": "EncodedImage:blob",
    "/upper/image": "EncodedImage:blob",
    "/side/image": "EncodedImage:blob",
    "/lower/height": "Image:buffer",
    "/upper/height": "Image:buffer",
    "/lower/surface": "foxglove.Grid:message",
    "/upper/surface": "foxglove.Grid:message",
    "/lower/flow": "foxglove.Grid:message",
    "/lower/pose": "InstancePoses3D:translations",
    "/upper/pose": "InstancePoses3D:translations",
    "/lower/transform": "Transform3D:translation",
    "/upper/transform": "Transform3D:translation",
    "/lower/arm": "tacsim.Arm:message",
    "/upper/arm": "tacsim.Arm:message",
    "/hand/gripper": "tacsim.Gripper:message",
    "/foot/gripper": "tacsim.Gripper:message",
    "/body": "Points3D:positions",
    "/upper/packages": "tacsim.ArmPackage:message",
    "/step": "tacsim.Step:message",
    **{f"/step/{name}": "tacsim.Scalar:message" for name in ("residual", "worst", "most", "hits")},
}


@pytest.mark.skipif(
    util.find_spec("rerun") is None or util.find_spec("rerun.chunk") is None, reason="needs a rerun that reads MCAP"
)
def test_every_topic_decodes(tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step]) -> None:
    from rerun.chunk import McapReader

    with Recorder(tmp_path / "e.mcap", meta) as recorder:
        for k in range(3):
            assert recorder.write(make_step(k, packages=True, body=True)) and recorder.flush()
    found: dict[str, dict[str, str]] = {}
    for chunk in McapReader(str(tmp_path / "e.mcap")).stream():
        columns = found.setdefault(str(chunk.entity_path), {})
        columns |= {field.name: str(field.type) for field in chunk.to_record_batch().schema}
    found = {entity: columns for entity, columns in found.items() if not entity.startswith("/__mcap")}
    drawn = {
        entity: sorted(n for n in columns if not n.startswith(("Mcap", "rerun.controls")) and "time" not in n)
        for entity, columns in found.items()
    }
    assert set(drawn) == set(DRAWN)
    assert {entity: DRAWN[entity] for entity in drawn if DRAWN[entity] not in drawn[entity]} == {}
    assert not [entity for entity, columns in found.items() if "McapMessage:data" in columns]  # of what is not decoded

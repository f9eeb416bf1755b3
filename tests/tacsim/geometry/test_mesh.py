"""STL files as users have them: good, broken, hostile."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tacsim.geometry import mesh as room
from tacsim.geometry.mesh import load_mesh, make_surface, signed_distance, signed_distance_on_grid

BOX = trimesh.creation.box((3, 5, 2))
BINARY: bytes = BOX.export(file_type="stl")
TEXT: str = BOX.export(file_type="stl_ascii")
RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def binary(triangles: np.ndarray) -> bytes:
    """A binary STL of `triangles` (m, 3, 3), normals left zero."""
    records = np.zeros(len(triangles), dtype=RECORD)
    records["corners"] = triangles
    return bytes(80) + len(triangles).to_bytes(4, "little") + records.tobytes()


def solid_box(**changes: np.ndarray) -> bytes:
    return binary(np.asarray(changes.get("triangles", BOX.triangles)))


@pytest.mark.parametrize("content", [BINARY, b"solid" + BINARY[5:], TEXT.encode(), TEXT.upper().encode(), solid_box()])
def test_binary_and_text_give_the_same_solid(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "box.STL"
    path.write_bytes(content)
    mesh = load_mesh(path, 1e-3)
    assert mesh.is_watertight
    assert len(mesh.vertices) == 8
    assert np.allclose(mesh.extents, [3e-3, 5e-3, 2e-3])
    assert mesh.volume == pytest.approx(30e-9)


def test_a_mesh_inside_out_is_turned(tmp_path: Path) -> None:
    path = tmp_path / "box.stl"
    path.write_bytes(binary(BOX.triangles[:, ::-1]))
    mesh = load_mesh(path, 1e-3)
    assert mesh.volume == pytest.approx(30e-9)
    assert (np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles_center) > 0).all()


def test_collapsed_triangles_are_harmless(tmp_path: Path) -> None:
    edge = BOX.triangles[0][[0, 1, 1]]
    path = tmp_path / "box.stl"
    path.write_bytes(binary(np.concatenate([BOX.triangles, [edge]])))
    assert len(load_mesh(path, 1e-3).faces) == 12


def test_normals_of_the_file_are_not_believed(tmp_path: Path) -> None:
    sphere = trimesh.creation.icosphere(3, 4.0)
    records = np.frombuffer(sphere.export(file_type="stl")[84:], dtype=RECORD).copy()
    records["normal"][200:] *= -1
    path = tmp_path / "sphere.stl"
    path.write_bytes(bytes(80) + len(records).to_bytes(4, "little") + records.tobytes())
    mesh = load_mesh(path, 1e-3)
    assert (np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles_center) > 0).all()


def nan_corner() -> bytes:
    triangles = BOX.triangles.copy()
    triangles[3, 1, 2] = np.nan
    return binary(triangles)


def sliver() -> bytes:
    """One edge of a box is split on one side only by a triangle without area."""
    a, b = BOX.triangles[0][0], BOX.triangles[0][1]
    middle = (a + b) / 2
    c = BOX.triangles[0][2]
    halves = [[a, middle, c], [middle, b, c], [a, b, middle]]
    return binary(np.concatenate([BOX.triangles[1:], halves]))


def one_turned() -> bytes:
    triangles = BOX.triangles.copy()
    triangles[4] = triangles[4][::-1]
    return binary(triangles)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lambda: b"", "the file is empty"),
        (lambda: BINARY[:-30], r"12 triangles should have 684 bytes but has 654 \(truncated\)"),
        (lambda: BINARY + b"xx", "too long"),
        (lambda: BINARY[:50], "neither a binary header nor 'solid'"),
        (lambda: b"once upon a time " * 40, "neither a binary header nor 'solid'"),
        (lambda: TEXT[: len(TEXT) // 2].encode(), "truncated"),
        (lambda: b"solid of revolution, a poem", "truncated"),
        (lambda: TEXT.replace("1.5", "abc").encode(), "no readable STL"),
        (lambda: TEXT.replace("1.5", "nan").encode(), "not finite"),
        (nan_corner, r"1 corners are not finite .* repair it"),
        (lambda: binary(BOX.triangles * np.array([1, 1, np.inf])), "not finite"),
        (lambda: bytes(84), "no triangles"),
        (lambda: b"solid nothing\nendsolid nothing\n", "no triangles"),
        (lambda: binary(BOX.triangles[1:]), r"not closed \(3 edges .*; repair it"),
        (one_turned, "face opposite ways"),
        (sliver, "1 triangles are degenerate"),
        (lambda: binary(BOX.triangles * np.array([1, 1, 0])), "measures"),
        (lambda: binary(BOX.triangles * 1e6), r"3e\+03 x 5e\+03 x 2e\+03 m at scale 0\.001 .* Is the scale right"),
        (lambda: binary(BOX.triangles * 1e-3), "Is the scale right"),
        (
            lambda: bytes(80) + (500_001).to_bytes(4, "little") + bytes(50 * 500_001),
            "500,001 triangles, the limit is 500,000",
        ),
    ],
)
def test_bad_files_are_refused_with_advice(tmp_path: Path, content: Callable[[], bytes], message: str) -> None:
    path = tmp_path / "part.stl"
    path.write_bytes(content())
    with pytest.raises(ValueError, match=message) as caught:
        load_mesh(path, 1e-3)
    assert str(path) in str(caught.value)


def test_bad_paths_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such mesh file"):
        load_mesh(tmp_path / "none.stl", 1e-3)
    (tmp_path / "part.obj").write_bytes(BINARY)
    with pytest.raises(ValueError, match=r"ends in '\.obj'"):
        load_mesh(tmp_path / "part.obj", 1e-3)
    (tmp_path / "folder.stl").mkdir()
    with pytest.raises(ValueError, match="is no file"):
        load_mesh(tmp_path / "folder.stl", 1e-3)


def test_size_is_checked_before_the_file_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "huge.stl"
    with path.open("wb") as file:
        file.truncate(room.MAX_BYTES + 1)  # sparse: takes no room
    monkeypatch.setattr(Path, "read_bytes", lambda self: pytest.fail("was read"))
    with pytest.raises(ValueError, match="67,108,865 bytes, the limit is 67,108,864; decimate"):
        load_mesh(path, 1e-3)


def test_trimesh_stays_quiet_and_its_logger_as_it_was(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    level = logging.getLogger("trimesh").level
    path = tmp_path / "part.stl"
    path.write_bytes(TEXT.replace("1.5", "abc").encode())
    with pytest.raises(ValueError):
        load_mesh(path, 1e-3)
    assert logging.getLogger("trimesh").level == level
    assert capfd.readouterr() == ("", "")


def test_a_grid_that_the_surface_does_not_enter_has_the_distance_from_its_nearest_node(tmp_path: Path) -> None:
    """In a ball and beside it: the node that is nearest to the surface is exact, and none is too near."""
    trimesh.creation.icosphere(4, 8.0).export(tmp_path / "ball.stl")
    surface = make_surface(load_mesh(tmp_path / "ball.stl", 1e-3))
    for place in ([1e-3, 0.5e-3, -1.2e-3], [9e-3, 2e-3, -12e-3]):
        axes = tuple(at + 0.1e-3 * np.arange(10) for at in place)
        found = signed_distance_on_grid(surface, axes, 0.2e-3).ravel()
        exact = signed_distance(surface, np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3))
        nearest = np.argmin(np.abs(exact))
        assert found[nearest] == pytest.approx(exact[nearest], rel=1e-9)
        assert (np.sign(found) == np.sign(exact)).all() and (np.abs(found) >= np.abs(exact) - 1e-12).all()

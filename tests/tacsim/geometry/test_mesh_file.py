"""STL, OBJ and PLY files as users have them: good, broken, hostile, in other units, with holes."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tacsim.geometry import mesh_file as room
from tacsim.geometry.mesh_file import describe_file, load_mesh

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
        (lambda: binary(BOX.triangles[1:]), r"not closed \(3 edges .*; give it `repair: true`"),
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
    (tmp_path / "part.step").write_bytes(BINARY)
    with pytest.raises(ValueError, match=r"ends in '\.step'\); use \.stl, \.obj, \.ply"):
        load_mesh(tmp_path / "part.step", 1e-3)
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


def obj_of_quads() -> bytes:
    """The box as a modelling program writes it: material, texture coordinates, normals, faces of four corners."""
    corners = trimesh.bounds.corners(BOX.bounds)
    lines = ["mtllib box.mtl", "o box", *(f"v {x} {y} {z}" for x, y, z in corners), "vt 0 0", "vn 0 0 1", "usemtl red"]
    for face in ((4, 3, 2, 1), (5, 6, 7, 8), (1, 2, 6, 5), (2, 3, 7, 6), (3, 4, 8, 7), (4, 1, 5, 8)):
        lines.append("f " + " ".join(f"{corner}/1/1" for corner in face))
    return "\n".join(lines).encode()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("box.obj", obj_of_quads()),
        ("box.OBJ", BOX.export(file_type="obj").encode()),
        ("box.ply", BOX.export(file_type="ply", encoding="binary")),
        ("text.ply", BOX.export(file_type="ply", encoding="ascii")),
    ],
)
def test_load_mesh_obj_and_ply_equal_stl(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    (tmp_path / "box.stl").write_bytes(BINARY)
    mesh, expected = load_mesh(tmp_path / name, 1e-3), load_mesh(tmp_path / "box.stl", 1e-3)
    assert mesh.volume == pytest.approx(expected.volume, rel=1e-6) and len(mesh.vertices) == 8
    assert np.allclose(np.sort(mesh.vertices, axis=0), np.sort(expected.vertices, axis=0), atol=1e-9)


PLY: bytes = BOX.export(file_type="ply", encoding="binary")
PLY_TEXT: bytes = BOX.export(file_type="ply", encoding="ascii")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("part.obj", b"", "the file is empty"),
        ("part.obj", BINARY, "is no OBJ"),
        ("part.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangles; a cloud of points"),
        ("part.obj", obj_of_quads()[:-40], "not closed"),
        ("part.obj", obj_of_quads().replace(b"8/1/1", b"9/1/1"), "no readable OBJ|not in the file|faces expected"),
        ("part.obj", obj_of_quads().replace(b"1.5", b"nan"), "not finite"),
        ("part.obj", b"once upon a time\n" * 40, "no triangles"),
        ("part.obj", b"v 0 0 0\n" + b"f 1 1 1\n" * 500_001, "500,001 triangles, the limit is 500,000"),
        ("part.ply", BINARY, "is no PLY"),
        ("part.ply", PLY[: len(PLY) // 2], "no readable PLY|faces expected"),
        ("part.ply", PLY[:-3], "no readable PLY|faces expected"),
        ("part.ply", PLY_TEXT[:-40], "no readable PLY|faces expected"),
        ("part.ply", PLY.replace(b"element face 12", b"element face 0"), "no triangles; a cloud of points"),
        ("part.ply", b"ply\nformat ascii 1.0\nelement vertex 3\n", "is no PLY"),
        ("part.ply", PLY.replace(b"element face 12", b"element face 999999999"), "999,999,999 triangles, the limit"),
    ],
)
def test_load_mesh_bad_obj_and_ply_are_refused(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        load_mesh(path, 1e-3)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("largest_side", "scale", "unit"),
    [(0.02, 1.0, "metres"), (0.999, 1.0, "metres"), (1.0, 1e-3, "millimetres"), (16.0, 1e-3, "millimetres")],
)
def test_load_mesh_without_scale_guesses_unit_and_says_it(
    tmp_path: Path, largest_side: float, scale: float, unit: str
) -> None:
    ball = trimesh.creation.box((largest_side, largest_side / 2, largest_side / 2))
    ball.export(tmp_path / "part.ply")
    mesh = load_mesh(tmp_path / "part.ply", None)
    assert mesh.extents[0] == pytest.approx(largest_side * scale, rel=1e-6) and mesh.metadata["scale"] == scale
    (words,) = describe_file(mesh, None)
    assert unit in words and f"{largest_side * scale * 1e3:.3g} x" in words
    assert describe_file(load_mesh(tmp_path / "part.ply", scale), scale) == []


def write_open(path: Path, mesh: trimesh.Trimesh, keep: np.ndarray) -> Path:
    mesh = mesh.copy()
    mesh.update_faces(keep)
    mesh.export(path)
    return path


def test_load_mesh_repair_closes_holes_and_states_them(tmp_path: Path) -> None:
    """A cylinder without its bottom: the repaired volume is that of the whole one."""
    whole = trimesh.creation.cylinder(3.0, 8.0, sections=48)
    open_file = write_open(tmp_path / "cup.stl", whole, whole.face_normals[:, 2] > -0.9)
    with pytest.raises(ValueError, match=r"48 edges do not join .*`repair: true`"):
        load_mesh(open_file, 1e-3)
    mesh = load_mesh(open_file, 1e-3, repair=True)
    assert mesh.volume == pytest.approx(whole.volume * 1e-9, rel=1e-6)
    assert mesh.metadata["repairs"] == ["holes closed: 1, the largest 8.49 mm wide with 48 edges"]


def test_load_mesh_repair_closes_a_missing_triangle_and_turns_others(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(2, 4.0)
    faces = np.array(ball.faces)
    faces[10:14] = faces[10:14, ::-1]
    turned = trimesh.Trimesh(ball.vertices, np.concatenate([faces[1:], faces[5:6]]), process=False)
    turned.export(tmp_path / "ball.obj")
    mesh = load_mesh(tmp_path / "ball.obj", 1e-3, repair=True)
    assert mesh.volume == pytest.approx(ball.volume * 1e-9, rel=1e-6) and mesh.is_winding_consistent
    assert [words.partition(": ")[2][:1] for words in mesh.metadata["repairs"]] == ["1", "4", "1"]


def test_load_mesh_repair_leaves_a_closed_mesh_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "box.stl").write_bytes(BINARY)
    mesh, plain = load_mesh(tmp_path / "box.stl", 1e-3, repair=True), load_mesh(tmp_path / "box.stl", 1e-3)
    assert mesh.metadata["repairs"] == [] and np.array_equal(mesh.triangles, plain.triangles)


def test_load_mesh_repair_refuses_a_rim_that_its_middle_does_not_see(tmp_path: Path) -> None:
    """The end face of a bar with the section of a C is a hole whose middle lies outside of it."""
    angles = np.linspace(0.2, 2 * np.pi - 0.2, 30)
    ring = np.concatenate([
        np.stack([4 * np.cos(angles), 4 * np.sin(angles)], axis=1),
        np.stack([3 * np.cos(angles[::-1]), 3 * np.sin(angles[::-1])], axis=1),
    ])  # fmt: skip
    count = len(ring)
    at, after = np.arange(count), (np.arange(count) + 1) % count
    corners = np.concatenate([np.c_[ring, np.zeros(count)], np.c_[ring, np.full(count, 5.0)]])
    sides = np.concatenate([np.c_[at, after, after + count], np.c_[at, after + count, at + count]])
    trimesh.Trimesh(corners, sides, process=False).export(tmp_path / "c.stl")
    with pytest.raises(ValueError, match=r"cannot be repaired: the rim of a hole \(60 edges"):
        load_mesh(tmp_path / "c.stl", 1e-3, repair=True)


def test_load_mesh_repair_refuses_rims_that_touch(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(2, 4.0)
    around = np.flatnonzero((ball.faces == 100).any(axis=1))
    opposite = next(f for f in around if np.isin(ball.faces[f], ball.faces[around[0]]).sum() == 1)
    keep = np.ones(len(ball.faces), bool)
    keep[[around[0], opposite]] = False
    with pytest.raises(ValueError, match="rims of two holes touch"):
        load_mesh(write_open(tmp_path / "ball.stl", ball, keep), 1e-3, repair=True)

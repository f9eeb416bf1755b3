"""What is written is there whole or not at all, and nothing of anybody else's is overwritten."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from robot.common.whole_file import move_to_new_path, whole_folder


def test_whole_folder_is_complete_or_absent(tmp_path: Path) -> None:
    with whole_folder(tmp_path / "new" / "set") as place:
        (place / "one").write_text("1")
        assert not (tmp_path / "new").exists()
    assert (tmp_path / "new" / "set" / "one").read_text() == "1"
    with pytest.raises(FileNotFoundError), whole_folder(tmp_path / "other") as place:
        (place / "one").write_text((place / "nothing").read_text())
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


def test_whole_folder_made_by_other_process_is_kept(tmp_path: Path) -> None:
    with pytest.raises(FileExistsError) as raised, whole_folder(tmp_path / "set"):
        (tmp_path / "set" / "theirs").mkdir(parents=True)
    assert raised.value.filename == str(tmp_path / "set")
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")] == ["set", "set/theirs"]


def test_whole_folder_error_names_requested_folder(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No space") as raised, whole_folder(tmp_path / "set") as place:
        raise OSError(errno.ENOSPC, "No space left on device", str(place / "one"))
    assert raised.value.filename == str(tmp_path / "set")
    with pytest.raises(OSError, match="No such file") as raised, whole_folder(tmp_path / "set"):
        (tmp_path / "nowhere").read_text()
    assert raised.value.filename == str(tmp_path / "nowhere")


@pytest.mark.parametrize("links", [True, False])
def test_move_to_new_path_existing_file_is_refused(
    links: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not links:

        def refuse(*places: Path) -> None:
            raise OSError(errno.EPERM, "Operation not permitted")

        monkeypatch.setattr(os, "link", refuse)
    for text in ("first", "second"):
        (tmp_path / "part").write_text(text)
        if text == "first":
            move_to_new_path(tmp_path / "part", tmp_path / "file")
            assert not (tmp_path / "part").exists()
        else:
            with pytest.raises(FileExistsError):
                move_to_new_path(tmp_path / "part", tmp_path / "file")
    assert (tmp_path / "file").read_text() == "first"

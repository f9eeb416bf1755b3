from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from calibration.errors import BadFrames
from calibration.frame_set import FrameSet, read_folder, read_frame_set, rectified_by_view
from calibration.lens.view import view_of_corners
from tests.calibration.presses import HiddenSensor
from tests.calibration.sources import save, save_picture, side, write_presses


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_presses(tmp_path / "frames")


def test_more_frames_without_contact_have_its_name_and_a_number(folder: Path) -> None:
    for number in (10, 2):
        save_picture(folder / f"background_{number}.png", np.full_like(read_folder(folder).reference, number))
    frames = read_folder(folder)
    assert [frame.name for frame in frames.frames] == [f"press_{i}.png" for i in range(5)]
    assert sorted(int(image.max()) for image in frames.untouched_images[1:]) == [2, 10]
    np.testing.assert_array_equal(frames.untouched_images[0], frames.reference)
    # presses are presses, though the reference that is named has their name
    (folder / "Background.png").rename(folder / "press.png")
    named = read_folder(folder, folder / "press.png")
    assert len(named.frames) == 5 and len(named.untouched_images) == 3
    np.testing.assert_array_equal(named.reference, frames.reference)


def test_all_frames_are_rectified_and_must_fit_the_view(folder: Path) -> None:
    view = view_of_corners(((20.0, 10.0), (240.0, 15.0), (235.0, 190.0), (15.0, 185.0)), (16e-3, 12e-3), (200, 260))
    save_picture(folder / "background_2.png", HiddenSensor(5).empty())
    frames = read_folder(folder)
    seen = rectified_by_view(frames, view)
    shape = (view.geometry.height, view.geometry.width, 3)
    assert {image.shape for image in (*seen.untouched_images, *(frame.image for frame in seen.frames))} == {shape}
    np.testing.assert_array_equal(seen.untouched_images[0], seen.reference)
    assert (seen.untouched_images[1] != seen.reference).any()
    save_picture(folder / "background_2.png", HiddenSensor(5).empty()[:100])
    with pytest.raises(BadFrames, match="260 x 200"):
        rectified_by_view(read_folder(folder), view)


def test_or_is_named_or_is_the_median(folder: Path) -> None:
    untouched = read_folder(folder).reference
    moved = folder.parent / "elsewhere.png"
    (folder / "Background.png").rename(moved)
    named = read_folder(folder, moved)
    assert named.reference_from == "elsewhere.png" and not named.estimated
    np.testing.assert_array_equal(named.reference, untouched)
    median = read_folder(folder)
    assert median.estimated and median.reference_from == "median of 5 frames"
    assert np.abs(median.reference.astype(int) - untouched).mean() < 2.5
    (folder / "press_0.png").unlink()
    with pytest.raises(BadFrames, match=r"no frame without contact.*--reference-a.*background\.png"):
        read_folder(folder)


def test_what_cannot_be_read_is_named(folder: Path) -> None:
    (folder / "press_9.png").write_bytes(b"no picture")
    with pytest.raises(BadFrames, match=r"press_9\.png"):
        read_folder(folder)
    with pytest.raises(BadFrames, match="is no folder"):
        read_folder(folder / "press_0.png")
    empty = folder.parent / "empty"
    empty.mkdir()
    with pytest.raises(BadFrames, match="no pictures in this folder"):
        read_folder(empty)


@pytest.fixture(scope="module")
def real() -> FrameSet:
    return side(HiddenSensor(3), name="real")


def test_a_folder_is_read_with_its_references(real: FrameSet, tmp_path: Path) -> None:
    read = read_frame_set(save(real, tmp_path / "real"))
    assert read.reference_from == "background.png"
    assert [frame.name for frame in read.frames] == [frame.name for frame in real.frames]
    assert [frame.name for frame in read.untouched] == ["background_2.png", "background_3.png"]
    assert np.array_equal(read.frames[2].image, real.frames[2].image)


def test_every_unreadable_picture_is_named(real: FrameSet, tmp_path: Path) -> None:
    folder = save(real, tmp_path / "real")
    whole = (folder / "press_1.png").read_bytes()
    for name in ("press_1.png", "press_3.png"):
        (folder / name).write_bytes(whole[: len(whole) // 2])  # a head, but no body
    with pytest.raises(BadFrames) as caught:
        read_frame_set(folder)
    assert "press_1.png" in str(caught.value) and "press_3.png" in str(caught.value)
    (folder / "press_1.png").write_bytes(b"nothing")
    with pytest.raises(BadFrames, match=r"press_1\.png: no readable picture"):
        read_frame_set(folder)


def test_mixed_sizes_empty_folders_and_other_files_are_refused(real: FrameSet, tmp_path: Path) -> None:
    folder = save(real, tmp_path / "real")
    Image.fromarray(real.reference[:100]).save(folder / "press_9.png")
    with pytest.raises(BadFrames, match=r"press_9\.png: 260 x 100 pixels"):
        read_frame_set(folder)
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadFrames, match="no pictures in this folder"):
        read_frame_set(tmp_path / "empty")
    with pytest.raises(BadFrames, match="no such file or folder"):
        read_frame_set(tmp_path / "nowhere")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(BadFrames, match="no recording"):
        read_frame_set(tmp_path / "notes.txt")
    (tmp_path / "bad.mcap").write_bytes(b"\0" * 100)
    with pytest.raises(BadFrames, match=r"bad\.mcap"):
        read_frame_set(tmp_path / "bad.mcap")


def test_a_reference_alone_or_of_another_size_is_refused(real: FrameSet, tmp_path: Path) -> None:
    folder = save(replace(real, frames=()), tmp_path / "real")
    with pytest.raises(BadFrames, match="no frame except the one without contact"):
        read_frame_set(folder)
    pressed = save(replace(real, untouched=()), tmp_path / "pressed")
    Image.fromarray(real.reference[:150]).save(tmp_path / "small.png")
    with pytest.raises(BadFrames, match=r"press_0\.png is 260 x 200 px.*small\.png\) 260 x 150"):
        read_frame_set(pressed, tmp_path / "small.png")
    with pytest.raises(BadFrames, match=r"none\.png"):
        read_frame_set(pressed, tmp_path / "none.png")


def test_a_huge_picture_is_refused_before_it_is_decoded(real: FrameSet, tmp_path: Path) -> None:
    folder = save(real, tmp_path / "real")
    Image.new("1", (5000, 10)).save(folder / "huge.png")
    with pytest.raises(BadFrames, match=r"huge\.png: 5000 x 10 pixels"):
        read_frame_set(folder)


def test_too_many_frames_are_refused(tmp_path: Path, real: FrameSet) -> None:
    with pytest.raises(BadFrames, match="more than 3 frames"):
        read_folder(save(real, tmp_path / "real"), max_frames=3)

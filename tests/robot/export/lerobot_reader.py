"""Reads a LeRobot data set as LeRobot 0.6.1 does, without it, and is stricter: what is not as the format says fails."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pyarrow import parquet

COUNTERS = ("frame_index", "episode_index", "index", "task_index")
STATISTICS = {"min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"}


def read_dataset(folder: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """info.json, and all columns over all frames, pictures decoded. AssertionError for what is not as it has to be."""
    info = json.loads((folder / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["chunks_size"] == 1000
    assert isinstance(info["fps"], int) and info["fps"] > 0
    features = info["features"]
    in_data = {name: feature for name, feature in features.items() if feature["dtype"] != "video"}
    videos = _videos(folder, info)
    assert all("/" not in name for name in features)
    episodes = _episodes(folder, info)
    tasks = _tasks(folder, info)
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in features}
    in_files: dict[Path, int] = {}
    for number, episode in enumerate(episodes):
        path = folder / info["data_path"].format(
            chunk_index=episode["data/chunk_index"], file_index=episode["data/file_index"]
        )
        group = in_files.get(path, 0)
        in_files[path] = group + 1
        file = parquet.ParquetFile(path)
        _check_told(file.schema_arrow.metadata[b"huggingface"], in_data)
        assert file.schema_arrow.names == list(in_data)
        columns = file.read_row_group(group).to_pydict()  # one episode is one row group
        length = episode["length"]
        assert episode["episode_index"] == number and {len(column) for column in columns.values()} == {length}
        assert episode["dataset_to_index"] - episode["dataset_from_index"] == length
        frames = range(length)
        assert columns["frame_index"] == list(frames) and set(columns["episode_index"]) == {number}
        assert columns["index"] == [episode["dataset_from_index"] + frame for frame in frames]
        assert columns["timestamp"] == [float(np.float32(frame / info["fps"])) for frame in frames]
        assert {tasks[index] for index in columns["task_index"]} == set(episode["tasks"])
        for name, feature in in_data.items():
            parts[name].append(_column(columns[name], feature, length))
        for name, files in videos.items():
            parts[name].append(_shown(files, name, episode, info["fps"]))
    assert all(frame is None for files in videos.values() for frames in files.values() for frame in frames)  # all taken
    assert sorted(in_files) == sorted((folder / "data").rglob("*.parquet"))
    assert all(parquet.ParquetFile(path).num_row_groups == count for path, count in in_files.items())
    whole = {name: np.concatenate(each) for name, each in parts.items()}
    assert len(whole["index"]) == info["total_frames"]
    _check_statistics(json.loads((folder / "meta/stats.json").read_text()), features, info["total_frames"])
    return info, whole


def _episodes(folder: Path, info: dict[str, Any]) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for path in sorted((folder / "meta/episodes").glob("*/*.parquet")):
        found = parquet.read_table(path).to_pylist()
        place = f"chunk-{found[0]['meta/episodes/chunk_index']:03d}/file-{found[0]['meta/episodes/file_index']:03d}"
        assert path == folder / f"meta/episodes/{place}.parquet"
        rows += found
    ends = [row["dataset_to_index"] for row in rows]
    assert [row["dataset_from_index"] for row in rows] == [0, *ends[:-1]] and ends[-1] == info["total_frames"]
    assert len(rows) == info["total_episodes"] and info["splits"] == {"train": f"0:{len(rows)}"}
    for row in rows:
        _check_statistics(
            {name: {key: row[f"stats/{name}/{key}"] for key in STATISTICS} for name in info["features"]},
            info["features"],
            row["length"],
        )
    return rows


def _tasks(folder: Path, info: dict[str, Any]) -> list[str]:
    table = parquet.read_table(folder / "meta/tasks.parquet")
    assert json.loads(table.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    assert table["task_index"].to_pylist() == list(range(info["total_tasks"]))
    tasks: list[str] = table["task"].to_pylist()
    return tasks


def _column(values: list[Any], feature: dict[str, Any], length: int) -> NDArray[Any]:
    if feature["dtype"] == "image":
        decoded = []
        for value in values:
            assert value["bytes"][:8] == b"\x89PNG\r\n\x1a\n" and value["path"] is None
            with Image.open(io.BytesIO(value["bytes"])) as picture:
                assert picture.mode == "RGB"
                decoded.append(np.array(picture))
        found = np.stack(decoded)
    else:
        found = np.array(values, feature["dtype"])
    one = feature["shape"] == [1]
    assert found.shape == ((length,) if one else (length, *feature["shape"]))
    if feature["names"] is not None:
        named = len(feature["shape"]) if len(feature["shape"]) > 1 else feature["shape"][0]
        assert len(feature["names"]) == named == len(set(feature["names"]))
    return found


def _videos(folder: Path, info: dict[str, Any]) -> dict[str, dict[tuple[int, int], list[Any]]]:
    """By column, the frames of each of its files, which must lie evenly in time."""
    names = [name for name, feature in info["features"].items() if feature["dtype"] == "video"]
    found: dict[str, dict[tuple[int, int], list[Any]]] = {name: {} for name in names}
    paths = sorted((folder / "videos").rglob("*.mp4"))
    assert (info["video_path"] is None) == (not names) and bool(paths) == bool(names)
    for name in names:
        feature = info["features"][name]
        told = {"video.height": feature["shape"][0], "video.width": feature["shape"][1], "video.channels": 3}
        told |= {"video.fps": info["fps"], "is_depth_map": False, "has_audio": False}
        assert told.items() <= feature["info"].items()
        for number in range(len(list((folder / "videos" / name).rglob("*.mp4")))):
            at = divmod(number, info["chunks_size"])
            path = folder / info["video_path"].format(video_key=name, chunk_index=at[0], file_index=at[1])
            paths.remove(path)
            found[name][at] = _frames(path, feature, info["fps"])
    assert not paths
    return found


def _frames(path: Path, feature: dict[str, Any], fps: int) -> list[NDArray[Any]]:
    import av

    with av.open(str(path)) as container:
        (stream,) = container.streams
        assert stream.codec.canonical_name == feature["info"]["video.codec"]
        assert stream.pix_fmt == feature["info"]["video.pix_fmt"] and stream.base_rate == fps
        decoded = list(container.decode(stream))
    assert np.allclose([frame.time for frame in decoded], np.arange(len(decoded)) / fps, atol=1e-4)  # LeRobot's bound
    found = [frame.to_ndarray(format="rgb24") for frame in decoded]
    assert all(list(each.shape) == feature["shape"] for each in found)
    return found


def _shown(files: dict[tuple[int, int], list[Any]], name: str, episode: dict[str, Any], fps: int) -> NDArray[Any]:
    """The frames of one episode: those of its file that no episode before it has."""
    place, begin, end = (
        tuple(episode[f"videos/{name}/{key}"] for key in keys)
        for keys in (("chunk_index", "file_index"), ("from_timestamp",), ("to_timestamp",))
    )
    frames = files[place]
    begins, ends = (round(each[0] * fps) for each in (begin, end))
    assert begins == sum(each is None for each in frames) and ends - begins == episode["length"]
    found = np.stack(frames[begins:ends])
    frames[begins:ends] = [None] * len(found)
    return found


def _check_told(text: bytes, features: dict[str, Any]) -> None:
    """What tells Hugging Face's `datasets` the types."""
    told = json.loads(text)["info"]["features"]
    assert list(told) == list(features)
    for name, feature in features.items():
        shape, number = feature["shape"], {"dtype": feature["dtype"], "_type": "Value"}
        if feature["dtype"] == "image":
            assert told[name] == {"_type": "Image"} and shape[2] == 3
        elif shape == [1]:
            assert told[name] == number
        elif len(shape) == 1:
            assert told[name] == {"feature": number, "length": shape[0], "_type": "List"}
        else:
            assert told[name] == {"shape": shape, "dtype": feature["dtype"], "_type": f"Array{len(shape)}D"}


def _check_statistics(statistics: dict[str, Any], features: dict[str, Any], frames: int) -> None:
    assert set(statistics) == set(features)
    for name, each in statistics.items():
        assert set(each) == STATISTICS and each["count"] == [frames]
        picture = features[name]["dtype"] in ("image", "video")
        shape = (3, 1, 1) if picture else tuple(features[name]["shape"])
        for key in STATISTICS - {"count"}:
            found = np.array(each[key])
            assert np.isfinite(found).all() and found.ndim == len(shape)
            assert np.broadcast_shapes(found.shape, shape) == shape
            if picture:
                assert found.shape == shape and found.min() >= 0.0 and found.max() <= 1.0

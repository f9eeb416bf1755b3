"""The files of a LeRobot data set, v3.0, written with pyarrow, without LeRobot.

Format: https://huggingface.co/docs/lerobot/lerobot-dataset-v3; where LeRobot 0.6 differs from that page, LeRobot 0.6.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robot.export.lerobot_mapping import Column, Feature, Statistics, arrow_table, column_statistics, merge_statistics
from robot.export.lerobot_video import VideoColumn

if TYPE_CHECKING:
    import pyarrow as pa

VERSION = "v3.0"
CHUNK = 1000  # files in a folder
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
COUNTERS = {name: Feature("int64", (1,), None) for name in ("frame_index", "episode_index", "index", "task_index")}
INDEX_COLUMNS = {"timestamp": Feature("float32", (1,), None), **COUNTERS}  # columns that every data set has


class DataSet:
    """A data set that is being written. `close` completes it.

    Args:
        folder: exists, and is empty.
        features: of the columns, without those of LeRobot (`INDEX_COLUMNS`).
        file_size, video_size: [MB] at which a new file starts.
        video: write pictures as videos, instead of PNG in the data files.

    Raises:
        OSError, VideoFailed.
    """

    def __init__(
        self,
        folder: Path,
        fps: float,
        robot: str,
        features: Mapping[str, Feature],
        *,
        file_size: float = 100,
        video_size: float = 200,
        video: bool = False,
    ) -> None:
        self._folder, self._fps, self._robot = folder, fps, robot
        self._file_size, self._video_size = file_size, video_size
        self._features = {**features, **INDEX_COLUMNS}
        self.videos = {
            name: VideoColumn(self._video_path(name), fps, feature.shape, video_size, CHUNK)
            for name, feature in features.items()
            if video and feature.dtype == "image"
        }
        self._tasks: list[str] = []
        self._rows: list[dict[str, Any]] = []  # of meta/episodes, not yet written
        self._statistics: list[dict[str, Statistics]] = []
        self._episodes = self._frames = 0
        self._data = _Files(folder / "data", file_size)
        self._meta = _Files(folder / "meta" / "episodes", file_size)

    def add(self, columns: Mapping[str, Column], images: Mapping[str, Statistics], task: str) -> None:
        """Adds an episode: its columns, and the statistics of its pictures by column."""
        max_buffered = 100  # rows of meta/episodes in one row group
        count = len(next(iter(columns.values())))
        if task not in self._tasks:
            self._tasks.append(task)
        frame = np.arange(count)
        index_columns: dict[str, Column] = {
            "timestamp": (frame / self._fps).astype(np.float32),
            "frame_index": frame,
            "episode_index": np.full(count, self._episodes),
            "index": self._frames + frame,
            "task_index": np.full(count, self._tasks.index(task)),
        }
        whole = {**columns, **{name: np.asarray(each)[:, None] for name, each in index_columns.items()}}
        statistics = {
            name: images[name] if feature.dtype == "image" else column_statistics(np.asarray(whole[name]))
            for name, feature in self._features.items()
        }
        in_data = {name: feature for name, feature in self._features.items() if name not in self.videos}
        chunk, file = self._data.write(arrow_table(in_data, whole), count)
        video_places = {name: video.add(_pictures(columns[name])) for name, video in self.videos.items()}
        self._rows.append(
            {
                "episode_index": self._episodes,
                "tasks": [task],
                "length": count,
                "data/chunk_index": chunk,
                "data/file_index": file,
                "dataset_from_index": self._frames,
                "dataset_to_index": self._frames + count,
                **{f"videos/{name}/{key}": value for name, each in video_places.items() for key, value in each.items()},
                **{f"stats/{name}/{key}": v.tolist() for name, each in statistics.items() for key, v in each.items()},
            }
        )
        self._statistics.append(statistics)
        self._episodes, self._frames = self._episodes + 1, self._frames + count
        if len(self._rows) == max_buffered:
            self._write_rows()

    def close(self) -> None:
        """Writes the files that belong to the whole data set."""
        if self._rows:
            self._write_rows()
        for video in self.videos.values():
            video.close()
        self._data.close()
        self._meta.close()
        _write_tasks(self._folder / "meta" / "tasks.parquet", self._tasks)
        statistics = {name: merge_statistics([each[name] for each in self._statistics]) for name in self._features}
        texts = {name: {key: value.tolist() for key, value in each.items()} for name, each in statistics.items()}
        write_json(self._folder / "meta" / "stats.json", texts)
        write_json(self._folder / "meta" / "info.json", self._info())

    def _info(self) -> dict[str, Any]:
        return {
            "codebase_version": VERSION,
            "robot_type": self._robot,
            "fps": self._fps,
            "total_episodes": self._episodes,
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": CHUNK,
            "data_files_size_in_mb": self._file_size,
            "video_files_size_in_mb": self._video_size,
            "splits": {"train": f"0:{self._episodes}"},
            "data_path": f"data/{FILE}",
            "video_path": VIDEO if self.videos else None,
            "features": {name: self._feature_info(name, feature) for name, feature in self._features.items()},
        }

    def _feature_info(self, name: str, feature: Feature) -> dict[str, Any]:
        info = {"dtype": feature.dtype, "shape": list(feature.shape), "names": feature.names and list(feature.names)}
        return info | ({"dtype": "video", "info": self.videos[name].info} if name in self.videos else {})

    def _video_path(self, name: str) -> str:
        """Path template of the video files of a column, without chunk and file numbers."""
        return str(self._folder / VIDEO.replace("{video_key}", name))

    def _write_rows(self) -> None:
        import pyarrow as pa

        table = pa.Table.from_pylist(self._rows)
        chunk, file = self._meta.place(table.num_rows)
        for name, value in (("chunk_index", chunk), ("file_index", file)):
            table = table.append_column(f"meta/episodes/{name}", pa.array([value] * table.num_rows, pa.int64()))
        self._meta.write(table, table.num_rows)
        self._rows = []


@dataclass(slots=True)
class _Files:
    """Parquet files of one kind. A table is one row group; a new file starts where the next table would exceed the
    size."""

    folder: Path
    size: float  # [MB]
    _number: int = 0  # of the file, over all chunks
    _count: int = 0  # rows in it
    _path: Path | None = None
    _writer: Any = field(default=None)

    def place(self, count: int) -> tuple[int, int]:
        """Chunk and file of the next `count` rows. Starts a new file if they do not fit."""
        if self._path is not None and self._count:
            used = self._path.stat().st_size / 2**20
            if used * (1 + count / self._count) >= self.size:
                self.close()
                self._number, self._count, self._path = self._number + 1, 0, None
        return divmod(self._number, CHUNK)

    def write(self, table: pa.Table, count: int) -> tuple[int, int]:
        """Writes a table. Returns its chunk and its file."""
        from pyarrow import parquet

        chunk, file = self.place(count)
        if self._path is None:
            self._path = self.folder / FILE.format(chunk_index=chunk, file_index=file)
            self._path.parent.mkdir(parents=True, exist_ok=True)
            # Measured numbers do not repeat, so a dictionary would only add size; pictures are already PNG.
            self._writer = parquet.ParquetWriter(self._path, table.schema, compression="zstd", use_dictionary=False)
        self._writer.write_table(table, row_group_size=max(count, 1))
        self._count += count
        return chunk, file

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None


def _pictures(column: Column) -> Sequence[bytes]:
    assert not isinstance(column, np.ndarray)
    return column


def _write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Writes tasks.parquet. LeRobot reads it with pandas, and needs `task` as its index."""
    import pyarrow as pa
    from pyarrow import parquet

    types = {"task_index": ("int64", "int64"), "task": ("unicode", "object")}
    info = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
            for name, (kind, numpy) in types.items()
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.0",
    }
    schema = pa.schema([("task_index", pa.int64()), ("task", pa.string())], metadata={"pandas": json.dumps(info)})
    parquet.write_table(pa.table([list(range(len(tasks))), list(tasks)], schema=schema), path)


def write_json(path: Path, value: Any) -> None:
    """Writes a JSON file. Raises OSError; ValueError for NaN or infinity, which JSON lacks."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=4, allow_nan=False) + "\n", encoding="utf-8")

"""Pictures of a data set as H.264 video without colour subsampling, and its error, measured while writing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from importlib import util
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim.record.images import decode_image

ENCODER, CODEC, PIXELS = "libx264", "h264", "yuv444p"
QUALITY = 10  # crf: 0 is best; LeRobot's default, AV1 yuv420p at 30, has an error of 4.6 grey levels
KEY_FRAMES = 2  # distance of key frames, as in LeRobot, which loads single frames


class VideoFailed(RuntimeError):
    """The encoder failed. The data set is removed."""


def require_video() -> None:
    """Raises ValueError if videos cannot be written."""
    if util.find_spec("av") is None:
        raise ValueError("writing videos needs PyAV, which is not installed: pip install 'tacsim[video]'")
    import av

    try:
        av.Codec(ENCODER, "w")
    except ValueError:
        raise ValueError(
            f"the PyAV that is installed ({av.__version__}) was built without the encoder {ENCODER}; install the wheel "
            "of PyAV, or leave --video out"
        ) from None


class VideoError:
    """Differences between pictures and their video [grey levels of 255]."""

    def __init__(self) -> None:
        self._squares = np.zeros(3)  # sums of squares: of the error, of the error in contact, of the signal in contact
        self._counts = np.zeros(2, np.int64)  # number of values, and of those in contact
        self._max_error = 0

    def add(self, picture: NDArray[np.uint8], decoded: NDArray[np.uint8]) -> None:
        """Adds a picture and its decoded video frame, both (H, W, 3)."""
        min_change = 10  # grey levels; a larger difference from grey counts as contact
        grey = 128  # of a canonical picture where nothing changed
        error, signal = (each.astype(np.int64) - other for each, other in ((decoded, picture), (picture, grey)))
        contact = np.abs(signal) > min_change
        self._squares += [(error**2).sum(), (error[contact] ** 2).sum(), (signal[contact] ** 2).sum()]
        self._counts += np.array([error.size, contact.sum()])
        self._max_error = max(self._max_error, int(np.abs(error).max()))

    def summarise(self) -> dict[str, float | int]:
        """Errors by name. In contact: of values that differ from grey by more than 10 grey levels; 0 without any."""
        total, contact = (max(int(count), 1) for count in self._counts)
        rms = np.sqrt(self._squares / [total, contact, contact]).round(4).tolist()
        return {"rms": rms[0], "rms_in_contact": rms[1], "signal_in_contact": rms[2], "most": self._max_error}


class VideoFile:
    """One file that is being written. Each frame is decoded again and compared.

    path: of a new file. rate: frames a second. shape: (H, W, 3) of the pictures.

    Raises:
        VideoFailed, OSError.
    """

    def __init__(self, path: Path, rate: float, shape: tuple[int, ...], error: VideoError) -> None:
        import av

        path.parent.mkdir(parents=True, exist_ok=True)
        self._error, self._path = error, path
        self.frames = self.size = 0  # pictures taken, and bytes of them in the video
        self._waiting: dict[int, NDArray[np.uint8]] = {}  # by frame, until it is decoded
        exact = Fraction(rate).limit_denominator(1_000_000)
        options = {
            "crf": str(QUALITY),
            "g": str(KEY_FRAMES),
            "threads": "1",
        }  # one thread: the same bytes on all machines
        with self._failing():
            self._container: Any = av.open(str(path), "w", format="mp4")
            self._stream: Any = self._container.add_stream(ENCODER, rate=exact, options=options)
            self._stream.height, self._stream.width = shape[:2]
            self._stream.pix_fmt = PIXELS
            self._stream.codec_context.time_base = 1 / exact
        self._decoder: Any = av.CodecContext.create(CODEC, "r")

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Adds a picture (H, W, 3)."""
        import av

        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame.pts, frame.time_base = self.frames, self._stream.codec_context.time_base
        self._waiting[self.frames] = picture
        self.frames += 1
        self._encode(frame)

    def close(self) -> None:
        """Writes the remaining frames."""
        self._encode(None)
        self._compare(None)
        with self._failing():
            self._container.close()
        if self._waiting:
            raise VideoFailed(f"{self._path.name}: {len(self._waiting)} of {self.frames} pictures are not in the video")

    def _encode(self, frame: Any) -> None:
        with self._failing():
            packets = self._stream.encode(frame)
        for packet in packets:
            self.size += packet.size
            self._compare(packet)
            with self._failing():
                self._container.mux(packet)

    def _compare(self, packet: Any) -> None:
        with self._failing():
            if self._decoder.extradata is None:
                self._decoder.extradata = self._stream.codec_context.extradata
            for frame in self._decoder.decode(packet):
                self._error.add(self._waiting.pop(frame.pts), frame.to_ndarray(format="rgb24"))

    @contextmanager
    def _failing(self) -> Iterator[None]:
        """Raises an OSError of FFmpeg, such as a full disk, with the path, and other errors as VideoFailed."""
        import av

        try:
            yield
        except OSError as failure:
            raise OSError(failure.errno, failure.strerror, str(self._path)) from failure
        except av.error.FFmpegError as failure:
            raise VideoFailed(f"{self._path.name}: the encoder {ENCODER} failed: {failure}") from failure


class VideoColumn:
    """The pictures of one column, in consecutive files.

    template: of their paths, with chunk_index and file_index. size: [MB] at which a new file starts.

    Raises:
        VideoFailed, OSError.
    """

    def __init__(self, template: str, rate: float, shape: tuple[int, ...], size: float, chunk: int) -> None:
        self._template, self._rate, self._shape, self._size, self._chunk = template, rate, shape, size, chunk
        self._file: VideoFile | None = None
        self._number = 0  # of the file, over all chunks
        self.error = VideoError()

    def add(self, pictures: Sequence[bytes]) -> dict[str, int | float]:
        """Adds the PNG pictures of an episode. Returns chunk, file, and start and end time in the file [s]."""
        if self._file is not None and self._file.size * (1 + len(pictures) / self._file.frames) >= self._size * 2**20:
            self._file.close()
            self._file, self._number = None, self._number + 1
        chunk, number = divmod(self._number, self._chunk)
        if self._file is None:
            path = Path(self._template.format(chunk_index=chunk, file_index=number))
            self._file = VideoFile(path, self._rate, self._shape, self.error)
        begin = self._file.frames
        for picture in pictures:
            self._file.add(decode_image(picture, "picture"))
        begins, ends = (frame / self._rate for frame in (begin, self._file.frames))
        return {"chunk_index": chunk, "file_index": number, "from_timestamp": begins, "to_timestamp": ends}

    def close(self) -> None:
        """Writes the remaining frames."""
        if self._file is not None:
            self._file.close()
            self._file = None

    @property
    def info(self) -> dict[str, Any]:
        """Description of a video column in LeRobot."""
        return {
            "video.height": self._shape[0],
            "video.width": self._shape[1],
            "video.codec": CODEC,
            "video.pix_fmt": PIXELS,
            "video.fps": self._rate,
            "video.channels": 3,
            "video.g": KEY_FRAMES,
            "video.crf": QUALITY,
            "video.video_backend": "pyav",
            "has_audio": False,
            "is_depth_map": False,
        }

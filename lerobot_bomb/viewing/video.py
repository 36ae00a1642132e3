"""Images as an MP4 that browsers play."""

from fractions import Fraction
from pathlib import Path
from typing import Self

import av
import cv2
import numpy as np
from av.video.stream import VideoStream

CODEC = "libx264"
QUALITY = "18"  # constant rate factor: hardly to be told from the images
PIXEL_FORMAT = "yuv420p"  # the one that all browsers play; width and height must be even


def packed(image: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 -> a PNG; drawn images shrink to a fiftieth."""
    return cv2.imencode(".png", image)[1]


def unpacked(image: np.ndarray) -> np.ndarray:
    """Invert `packed`."""
    return np.asarray(cv2.imdecode(image, cv2.IMREAD_COLOR))


class VideoFile:
    """H.264 in an MP4, written image by image."""

    def __init__(self, path: Path, fps: int) -> None:
        # the index first, so that a browser starts before it has the whole file
        self._file = av.open(str(path), "w", format="mp4", options={"movflags": "faststart"})
        self._fps = fps
        self._stream: VideoStream | None = None

    def add(self, image: np.ndarray) -> None:
        """Append (H, W, 3) uint8; all images have the size of the first."""
        height, width = image.shape[:2]
        even = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        if self._stream is None:
            self._stream = self._file.add_stream(CODEC, rate=Fraction(self._fps), options={"crf": QUALITY})
            self._stream.height, self._stream.width = even.shape[:2]
            self._stream.pix_fmt = PIXEL_FORMAT
        self._file.mux(self._stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._stream is not None:
            self._file.mux(self._stream.encode())
        self._file.close()

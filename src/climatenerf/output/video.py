"""Frames as PNG files and as an H.264 movie."""

import contextlib
import subprocess
import tempfile
from pathlib import Path
from types import TracebackType
from typing import IO, Self

import numpy as np
from jaxtyping import UInt8
from PIL import Image, PngImagePlugin

from climatenerf.core.errors import UserError
from climatenerf.core.storage import atomic_path

SIMULATED = (
    "simulated: weather was computed into a model fitted to photographs; this is no photograph and"
    " no forecast"
)
CRF = 18
"""Constant rate factor of x264: at 18 the movie is visually lossless."""


def write_png(
    path: Path | str,
    picture: UInt8[np.ndarray, "h w 3"] | np.ndarray,
    simulated: str,
    key: str | None = None,
) -> None:
    """Write a PNG atomically; its text chunk ``simulated`` states that it is no photograph.

    Args:
        path: the file.
        picture: 8-bit RGB or grey, or 16-bit grey.
        simulated: what was simulated, e.g. "clean render" or "flood 0.5 m".
        key: content of a text chunk ``key``, by which a frame is recognised.

    Raises:
        UserError: the disk is full, or the file cannot be written.
    """
    text = PngImagePlugin.PngInfo()
    text.add_itxt("simulated", simulated) if not simulated.isascii() else text.add_text(
        "simulated", simulated
    )
    if key is not None:
        text.add_text("key", key)
    with atomic_path(path) as temporary:
        # Level 4 is half the time of the default 6 for 3 % more bytes.
        Image.fromarray(picture).save(temporary, format="PNG", pnginfo=text, compress_level=4)


def find_ffmpeg() -> str:
    """Return the path of ffmpeg: `IMAGEIO_FFMPEG_EXE`, imageio-ffmpeg's own, or the system's.

    Raises:
        UserError: there is none.
    """
    try:
        import imageio_ffmpeg

        return imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise UserError(
            "the movie needs ffmpeg and none was found; run `pip install imageio-ffmpeg`, or"
            " install ffmpeg and set IMAGEIO_FFMPEG_EXE to its path"
        ) from error


def padding_note(name: str, size: tuple[int, int]) -> str | None:
    """Return a sentence about the even size that a movie is padded to; None if it needs no padding.

    Args:
        name: file name of the movie.
        size: width and height of the frames, pixels.
    """
    if size[0] % 2 == size[1] % 2 == 0:
        return None
    even = f"{size[0] + size[0] % 2}x{size[1] + size[1] % 2}"
    return f"{name} is padded to {even} pixels: H.264 needs even sizes"


class MovieWriter:
    """Stream frames into an MP4 (H.264, yuv420p, BT.709), which appears when it is complete.

    ``with MovieWriter(path, (480, 270), 24) as movie: movie.add(frame)``. An error of ffmpeg is
    stored in `problem`, and raised when the block ends, so that the caller can finish its frames.
    An exception inside the block leaves no new movie, and an older one unchanged.

    Attributes:
        problem: why there will be no movie, or None.
        note: how the movie differs from the frames (padding to even sizes), or None.
    """

    def __init__(self, path: Path | str, size: tuple[int, int], fps: float) -> None:
        """Prepare a movie.

        Args:
            path: the MP4 file.
            size: (width, height) of the frames, pixels. H.264 needs even numbers: an odd picture
                is padded by repeating its last column or row.
            fps: frames per second, > 0.
        """
        self.path = Path(path)
        self.size = size
        self.fps = fps
        self.problem: UserError | None = None
        self.note = padding_note(self.path.name, size)
        self._padding = (size[1] % 2, size[0] % 2)
        self._process: subprocess.Popen[bytes] | None = None
        self._log: IO[bytes] | None = None
        self._exit = contextlib.ExitStack()

    def __enter__(self) -> Self:
        """Start ffmpeg."""
        temporary = self._exit.enter_context(atomic_path(self.path))
        self._log = self._exit.enter_context(tempfile.TemporaryFile())
        try:
            self._process = subprocess.Popen(
                self._command(find_ffmpeg(), temporary),
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=self._log,
                # Ctrl-C reaches the whole process group of a terminal; ffmpeg has to outlive it.
                start_new_session=True,
            )
        except UserError as error:
            self.problem = error
        except OSError as error:
            self.problem = self._failure(f"ffmpeg does not start ({error.strerror})")
        return self

    def add(self, frame: UInt8[np.ndarray, "h w 3"]) -> None:
        """Append a frame: display-encoded 8-bit RGB of the movie's size."""
        if frame.shape != (self.size[1], self.size[0], 3) or frame.dtype != np.uint8:
            raise ValueError(f"frame {frame.shape} {frame.dtype} in a movie of {self.size}")
        if self.problem is not None or self._process is None or self._process.stdin is None:
            return
        rows, columns = self._padding
        padded = np.pad(frame, ((0, rows), (0, columns), (0, 0)), mode="edge")
        try:
            self._process.stdin.write(padded.tobytes())
        except OSError:  # ffmpeg has exited; the log holds its error
            self.problem = self._failure(self._last_error())

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Complete the movie, or remove it if the block failed."""
        process = self._process
        if process is not None:
            if kind is not None:
                process.kill()
            with contextlib.suppress(OSError):  # `add` has reported a broken pipe
                process.communicate()
            if process.returncode != 0 and self.problem is None:
                self.problem = self._failure(self._last_error())
        if kind is None and self.problem is not None:
            with contextlib.suppress(UserError):
                self._exit.__exit__(UserError, self.problem, None)
            raise self.problem
        self._exit.__exit__(kind, error, trace)

    def _command(self, ffmpeg: str, out: Path) -> list[str]:
        width, height = self.size[0] + self._padding[1], self.size[1] + self._padding[0]
        raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
        # Without these tags, players choose a wrong colour matrix from the picture size.
        colours = ["-vf", "scale=out_color_matrix=bt709:out_range=tv,format=yuv420p"]
        colours += ["-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709"]
        encoder = ["-c:v", "libx264", "-crf", str(CRF), "-preset", "medium"]
        # faststart writes the index first, so that a browser can play while it loads.
        container = ["-movflags", "+faststart", "-metadata", "comment=simulated", "-f", "mp4"]
        start = [ffmpeg, "-y", "-hide_banner", "-loglevel", "error", "-nostdin"]
        source = [*raw, "-r", f"{self.fps:g}", "-i", "pipe:0", "-an"]
        return [*start, *source, *encoder, *colours, *container, str(out)]

    def _last_error(self) -> str:
        if self._process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(timeout=5)
        if self._log is None:
            return "no reason given"
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else "no reason given"

    def _failure(self, reason: str) -> UserError:
        return UserError(
            f"no movie {self.path}: ffmpeg failed ({reason}); the frames are complete: free some"
            " disk space, or set IMAGEIO_FFMPEG_EXE to an ffmpeg with libx264"
        )

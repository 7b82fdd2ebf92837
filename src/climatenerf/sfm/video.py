"""Extract the sharpest frames of a video; HDR video (HLG, PQ) is tone-mapped to sRGB."""

import contextlib
import errno
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from climatenerf.core.errors import UserError
from climatenerf.core.hdr import Transfer, cube_lut
from climatenerf.core.storage import explain, make_folder, read_json, write_bytes, write_json

VIDEO_FRAMES = 100  # intervals of a video; the sharpest frame of each is used
CANDIDATES_PER_INTERVAL = 5  # decoded frames per interval
LUT = "tone-map.cube"
# ffmpeg's names, as its filter `showinfo` prints them.
_TRANSFERS: dict[str, Transfer] = {"arib-std-b67": "HLG", "smpte2084": "PQ"}
_PRIMARIES = {"bt709": "bt709", "bt2020": "bt2020", "smpte431": "p3", "smpte432": "p3"}
_MATRICES = {"bt709", "bt2020nc", "smpte170m", "bt470bg", "gbr"}  # known to ffmpeg's scaler


@dataclass(frozen=True)
class VideoFrames:
    """Frames of a video.

    Attributes:
        files: numbered JPEG files.
        notes: sentences for the user.
    """

    files: list[Path]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class HdrVideo:
    """Signal of an HDR video.

    Attributes:
        transfer: transfer function.
        primaries: as in `core.hdr.PRIMARIES`.
        has_matrix: True if the stream names the matrix of its Y'CbCr.
    """

    transfer: Transfer
    primaries: str
    has_matrix: bool


def small_grey(image: Image.Image) -> UInt8[np.ndarray, "h w"]:
    """Return grey values at a width of 640 pixels, so that statistics are comparable."""
    height = max(8, round(640 * image.height / image.width))
    return np.asarray(image.convert("L").resize((640, height), Image.Resampling.BILINEAR))


def sharpness(grey: UInt8[np.ndarray, "h w"]) -> float:
    """Return the variance of the 4-neighbour Laplacian, without the border pixels."""
    g = grey.astype(np.float32)
    neighbours = g[:-2, 1:-1] + g[2:, 1:-1] + g[1:-1, :-2] + g[1:-1, 2:]
    return float((neighbours - 4 * g[1:-1, 1:-1]).var())


def extract_frames(
    video: Path, folder: Path, max_side: int, progress: Callable[[int, int], None]
) -> VideoFrames:
    """Extract the sharpest frame of each of `VIDEO_FRAMES` intervals as numbered JPEG files.

    Args:
        video: the video file.
        folder: folder for the frames; complete frames of an earlier run are reused.
        max_side: largest width of a frame, pixels.
        progress: callback with (done, total).

    Raises:
        UserError: ffmpeg is missing or cannot decode the video, or the disk is full.
    """
    record_path = folder / "done.json"
    stamp = [video.stat().st_size, video.stat().st_mtime_ns]
    with contextlib.suppress(UserError, KeyError):
        frames, record = sorted(folder.glob("[0-9]*.jpg")), read_json(record_path)
        transfer = record["hdr"]  # missing in the record of a version without tone mapping
        if record["stamp"] == stamp and record["frames"] == len(frames):
            return VideoFrames(frames, _notes(video, transfer))
    try:
        import imageio_ffmpeg

        found = imageio_ffmpeg.get_ffmpeg_exe()
        ffmpeg = str(Path(shutil.which(found) or found).absolute())  # it runs in another folder
        count, seconds = imageio_ffmpeg.count_frames_and_secs(str(video))
    except (ImportError, RuntimeError, OSError) as error:
        raise UserError(
            f"{video} cannot be decoded ({str(error).strip().splitlines()[-1]});"
            " convert it to MP4 (H.264), or give photos instead"
        ) from error
    shutil.rmtree(folder, ignore_errors=True)
    make_folder(folder)
    if not count or not seconds or seconds <= 0:
        raise UserError(f"{video} contains no frames; record it again, or give photos instead")
    sampled = min(count, VIDEO_FRAMES * CANDIDATES_PER_INTERVAL)
    # All frames of a short video are candidates: a higher rate would duplicate some.
    rate = [] if sampled == count else [f"fps={sampled / seconds:.6f}"]
    scale, hdr = f"scale='min({max_side},iw)':-2", hdr_of_video(ffmpeg, video)
    filters = [*rate, scale] if hdr is None else [*rate, *_tone_mapping(scale, hdr)]
    if hdr is not None:
        write_bytes(folder / LUT, cube_lut(hdr.transfer, hdr.primaries).encode())
    command = [ffmpeg, "-y", "-loglevel", "error", "-nostdin", "-i", str(video.absolute())]
    command += ["-vf", ",".join(filters), "-fps_mode", "passthrough", "-q:v", "2"]
    command += ["candidate_%05d.jpg"]
    message = _run_ffmpeg(command, folder, lambda: progress(_count(folder), 2 * sampled))
    candidates = sorted(folder.glob("candidate_*.jpg"))
    if not candidates:
        raise UserError(
            f"{video} cannot be decoded ({message}); convert it to MP4 (H.264), or give photos"
            " instead"
        )
    frames = []
    intervals = min(VIDEO_FRAMES, len(candidates))
    for interval in np.array_split(np.array(candidates), intervals):
        sharpest = max(interval, key=lambda path: sharpness(small_grey(Image.open(path))))
        target = folder / f"{len(frames):04d}.jpg"
        sharpest.rename(target)
        frames.append(target)
        progress(sampled + len(frames), sampled + intervals)
    for path in folder.glob("candidate_*.jpg"):
        path.unlink()
    (folder / LUT).unlink(missing_ok=True)
    transfer = hdr.transfer if hdr else None
    write_json(record_path, {"stamp": stamp, "frames": len(frames), "hdr": transfer})
    return VideoFrames(frames, _notes(video, transfer))


def hdr_of_video(ffmpeg: str, video: Path) -> HdrVideo | None:
    """Return the HDR signal of a video from its first frame; None for SDR.

    ffmpeg decodes a frame, because the signal may be written in the container, in the video stream
    or in both. Broadcasts also use "BT.2020, preferably HLG". Dolby Vision of phones
    (profile 8.4) is HLG.
    """
    command = [
        ffmpeg,
        "-nostdin",
        "-hide_banner",
        "-i",
        str(video.absolute()),
        "-an",
        "-frames:v",
        "1",
    ]
    try:
        command += ["-vf", "showinfo", "-f", "null", "-"]
        done = subprocess.run(command, capture_output=True, timeout=120)
    except (OSError, subprocess.TimeoutExpired):
        return None
    text = done.stderr.decode(errors="replace")
    found = dict(re.findall(r"\bcolor_(space|primaries|trc):\s*([\w.-]+)", text))
    transfer = _TRANSFERS.get(found.get("trc", ""))
    if transfer is None:
        return None
    primaries = _PRIMARIES.get(found.get("primaries", ""), "bt2020")
    return HdrVideo(transfer, primaries, found.get("space") in _MATRICES)


def _tone_mapping(scale: str, hdr: HdrVideo) -> list[str]:
    """Return ffmpeg's filters that reduce frames by `scale` and tone-map them to sRGB.

    The filters zscale and tonemap are missing in many builds of ffmpeg; lut3d is in all.
    """
    matrix = "" if hdr.has_matrix else ":in_color_matrix=bt2020"
    return [
        f"{scale}:flags=bicubic+accurate_rnd+full_chroma_int{matrix}",
        "format=gbrp16le",
        f"lut3d=file={LUT}:interp=tetrahedral",
        "setparams=color_primaries=bt709:color_trc=iec61966-2-1",
        # JPEG (JFIF) prescribes the matrix of BT.601 in full range.
        "scale=out_color_matrix=bt601:out_range=full:flags=bicubic+accurate_rnd+full_chroma_int",
        "format=yuvj420p",
    ]


def _notes(video: Path, transfer: Transfer | None) -> tuple[str, ...]:
    if transfer is None:
        return ()
    return (f"{video} is HDR ({transfer}); its frames are tone-mapped to sRGB.",)


def _run_ffmpeg(command: list[str], folder: Path, on_wait: Callable[[], None]) -> str:
    """Run ffmpeg and return the last line of its messages.

    Args:
        command: program and arguments.
        folder: working folder of ffmpeg: of the frames and, meanwhile, of the log.
        on_wait: called about twice a second.

    Raises:
        UserError: the disk is full.
    """
    log = folder / "ffmpeg.log"
    with log.open("wb") as file:
        process = subprocess.Popen(command, stderr=file, cwd=folder)
    try:
        while process.poll() is None:
            on_wait()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(0.5)
    finally:
        process.kill()
        process.wait()
    messages = log.read_text(errors="replace").strip()
    log.unlink()
    if "No space left" in messages or (process.returncode and shutil.disk_usage(folder).free < 1e6):
        raise explain(OSError(errno.ENOSPC, ""), folder)
    return messages.splitlines()[-1] if messages else "no frame was decoded"


def _count(folder: Path) -> int:
    return sum(1 for _ in folder.glob("candidate_*.jpg"))

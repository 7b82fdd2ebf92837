"""HDR signals in closed form, written apart from `core.hdr`, and pictures and videos of them."""

import subprocess
from pathlib import Path

import numpy as np

CHART = np.array(
    [
        (115, 82, 68), (194, 150, 130), (98, 122, 157), (87, 108, 67), (133, 128, 177),
        (103, 189, 170), (214, 126, 44), (80, 91, 166), (193, 90, 99), (94, 60, 108),
        (157, 188, 64), (212, 163, 46), (56, 61, 150), (70, 148, 73), (175, 54, 60),
        (200, 199, 31), (187, 86, 149), (8, 133, 161), (243, 243, 242), (200, 200, 200),
        (160, 160, 160), (122, 122, 121), (85, 85, 85), (52, 52, 52),
    ]
)  # fmt: skip
"""ColorChecker in 8-bit sRGB, as published by its maker; one yellow lies within the gamut here."""

BT2020_FROM_BT709 = np.array(
    [
        [0.627404, 0.329283, 0.043313],
        [0.069097, 0.919540, 0.011362],
        [0.016391, 0.088013, 0.895595],
    ]
)
"""BT.2087-0, M1."""


def hlg_signal(linear):
    """Return the HLG signal for linear BT.709 light of a scene; 1 is recorded as 75 %."""
    scene = linear @ BT2020_FROM_BT709.T * 0.264962
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    log = a * np.log(np.maximum(12 * scene - b, 1e-9)) + c
    return np.where(scene <= 1 / 12, np.sqrt(3 * np.maximum(scene, 0)), log)


def pq_signal(linear, white=203.0):
    """Return the PQ signal for linear BT.709 light; 1 is shown with `white` cd/m2."""
    display = np.maximum(linear @ BT2020_FROM_BT709.T, 0) * white / 10000
    m1, m2, c1, c2, c3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875
    power = display**m1
    return ((c1 + c2 * power) / (1 + c3 * power)) ** m2


def chart_image(patch=32):
    """Return the chart as [h w 3] in linear BT.709, six patches wide."""
    linear = np.where(CHART <= 10.31475, CHART / 3294.6, ((CHART / 255 + 0.055) / 1.055) ** 2.4)
    return np.kron(linear.reshape(4, 6, 3), np.ones((patch, patch, 1)))


def patches(image, patch=32):
    """Return the mean colours [24 3] of the middles of the patches."""
    blocks = np.asarray(image, float).reshape(4, patch, 6, patch, 3)
    q = patch // 4
    return blocks[:, q:-q, :, q:-q].mean(axis=(1, 3)).reshape(24, 3)


def write_video(path: Path, signal, trc, primaries="bt2020", matrix="bt2020nc", frames=6):
    """Write a 10-bit video in limited range of one R'G'B' picture; return ffmpeg's result."""
    import imageio_ffmpeg

    height, width = signal.shape[:2]
    raw = np.rint(np.clip(signal, 0, 1) * 65535).astype("<u2")
    planes = [raw[..., i].tobytes() for i in (1, 2, 0)]  # gbrp
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-f", "rawvideo"]
    command += ["-pix_fmt", "gbrp16le", "-s", f"{width}x{height}", "-r", "10", "-i", "-"]
    scale = f"scale=out_color_matrix={'bt2020' if matrix == 'bt2020nc' else matrix}"
    tags = f"setparams=color_primaries={primaries}:color_trc={trc}:colorspace={matrix}:range=tv"
    command += ["-vf", f"{scale}:out_range=tv:flags=accurate_rnd,format=yuv420p10le,{tags}"]
    command += ["-c:v", "libx265", "-x265-params", "log-level=error:lossless=1"]
    command += ["-color_primaries", primaries, "-color_trc", trc, "-colorspace", matrix]
    command += ["-color_range", "tv", "-tag:v", "hvc1", str(path)]
    return subprocess.run(command, input=b"".join(planes) * frames, capture_output=True)

"""Compare poses estimated from photos with a capture's given poses, and time the estimation.

python benchmarks/capture_quality.py --captures ditch stone_sign --keep scenes --fit-steps 1500

Captures are names in ../shared/data; only their images/ are used as input. Positions are compared
after the best similarity transform, rotations after the best rotation. Up is compared with the up
direction that the reader derives from the given poses.

With --exif the photos are copies with EXIF data. GPS positions are those of the given cameras (in
the given scene's metres, with an error of 0.5 % of the extent on each axis). Every third copy is
stored sideways with an orientation tag, every fourth at three quarters of the size. `scale` is then
the estimated scene's metres over the given ones.

With --fit-steps three fits of that many steps are scored on the same held-out photos: with the
given poses; with the estimated poses and the photos as they are (the COLMAP model before
undistortion, so the same pixels); and with the estimated scene (undistorted pictures).
"""

import argparse
import json
import math
import tempfile
import time
from pathlib import Path

import numpy as np
from common import CAPTURES, command, report
from PIL import ExifTags, Image

from climatenerf.scene import Scene, load_scene, read_scene

HOME = (47.3769, 8.5417)  # latitude and longitude in the copies' EXIF data, degrees
GPS_NOISE = 0.005  # of the extent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--captures", nargs="+", default=["ditch", "stone_sign"])
    parser.add_argument("--keep", type=Path, help="folder for the scenes; default: deleted")
    parser.add_argument("--exif", action="store_true", help="use copies with EXIF, of two sizes")
    parser.add_argument("--fit-steps", type=int, default=0, help="0: no fits")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        for name in options.captures:
            out = (options.keep or Path(temporary)) / name
            given = read_scene(CAPTURES / name)
            photos = CAPTURES / name / "images"
            if options.exif:
                photos = copies(given, Path(temporary) / f"{name}-copies", options.seed)
            start = time.perf_counter()
            command("capture", str(photos), "-o", str(out), "--seed", str(options.seed))
            seconds = time.perf_counter() - start
            row = {"capture": name, "seconds": round(seconds, 1)}
            row |= pose_errors(given, load_scene(out))
            if options.fit_steps:
                same = Path(temporary) / f"{name}-same"
                model = str(out / "work" / "chosen")
                command("capture", str(photos), "--from-colmap", model, "-o", str(same))
                scenes = {"given": CAPTURES / name, "found": same, "found, undistorted": out}
                row["heldout"] = {
                    poses: fit_scores(scene, Path(temporary) / f"{name}-{poses}", options)
                    for poses, scene in scenes.items()
                }
            rows.append(row)
    question = "poses estimated from photos against given poses"
    report(question + (", copies with EXIF" if options.exif else ""), rows, options.seed)


def copies(given: Scene, folder: Path, seed: int) -> Path:
    """Write copies of a scene's photos with GPS, some rotated, some smaller; return the folder."""
    rng = np.random.default_rng(seed)
    folder.mkdir()
    positions = np.stack([given.c2w_world(view)[:3, 3] for view in given.views])
    noise = GPS_NOISE * np.linalg.norm(np.ptp(positions, axis=0))
    north_m = 111132.954 - 559.822 * math.cos(2 * math.radians(HOME[0]))
    east_m = 111412.84 * math.cos(math.radians(HOME[0]))
    for number, (view, position) in enumerate(zip(given.views, positions, strict=True)):
        x, y = position[:2] + noise * rng.normal(size=2)
        image = Image.open(view.path).convert("RGB")
        if number % 4 == 3:
            image = image.resize((image.width * 3 // 4, image.height * 3 // 4))
        data = Image.Exif()
        gps = data.get_ifd(ExifTags.IFD.GPSInfo)
        gps[ExifTags.GPS.GPSLatitudeRef], gps[ExifTags.GPS.GPSLongitudeRef] = "N", "E"
        gps[ExifTags.GPS.GPSLatitude] = (HOME[0] + y / north_m, 0.0, 0.0)
        gps[ExifTags.GPS.GPSLongitude] = (HOME[1] + x / east_m, 0.0, 0.0)
        if number % 3 == 0:
            data[ExifTags.Base.Orientation] = 6
            image = image.transpose(Image.Transpose.ROTATE_90)
        image.save(folder / f"{Path(view.name).stem}.jpg", quality=95, exif=data)
    return folder


def fit_scores(scene: Path, run: Path, options: argparse.Namespace) -> dict:
    """Fit a scene in `--fit-steps` steps; return its scores on held-out photos."""
    args = ["--steps", str(options.fit_steps), "--minutes", "60", "--seed", str(options.seed)]
    command("fit", str(scene), "-o", str(run), *args)
    measured = json.loads((run / "metrics.json").read_text())
    return {key: measured[key] for key in ("psnr", "psnr_cc", "ssim", "steps", "seconds")}


def pose_errors(given: Scene, found: Scene) -> dict:
    """Return the number of registered photos, and errors of positions, rotations, up and scale."""
    by_stem = {Path(view.name).stem: view for view in given.views}
    estimated = np.stack([found.c2w_world(view) for view in found.views])
    true = np.stack([given.c2w_world(by_stem[Path(view.name).stem]) for view in found.views])
    a, b = estimated[:, :3, 3], true[:, :3, 3]
    rotation, stretch = rotation_of((b - b.mean(0)).T @ (a - a.mean(0)))
    scale = stretch / ((a - a.mean(0)) ** 2).sum()
    distance = np.linalg.norm(scale * (a - a.mean(0)) @ rotation.T - (b - b.mean(0)), axis=-1)
    extent = np.linalg.norm(np.ptp(b, axis=0))
    rotation, _ = rotation_of((true[:, :3, :3] @ estimated[:, :3, :3].transpose(0, 2, 1)).sum(0))
    between = rotation @ estimated[:, :3, :3] @ true[:, :3, :3].transpose(0, 2, 1)
    cosine = (np.trace(between, axis1=1, axis2=2) - 1) / 2
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return {
        "registered": len(found.views),
        "pictures": len(given.views),
        "position_percent_of_extent": {
            "median": float(100 * np.median(distance) / extent),
            "max": float(100 * distance.max() / extent),
        },
        "rotation_degrees": {"median": float(np.median(angle)), "max": float(angle.max())},
        "up_degrees": float(np.degrees(np.arccos(min(1.0, rotation[2, 2])))),
        "scale_source": found.scale_source,
        "scale": float(1 / scale),
        "scale_error_estimated": found.scale_error,
    }


def rotation_of(matrix: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the rotation nearest to a 3x3 matrix, and the trace of the rest (Umeyama 1991)."""
    u, d, vt = np.linalg.svd(matrix)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return u @ np.diag(sign) @ vt, float((d * sign).sum())


if __name__ == "__main__":
    main()

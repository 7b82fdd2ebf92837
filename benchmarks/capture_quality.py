"""How good are poses from bare photos, against a capture's given poses, and how long do they take?

python benchmarks/capture_quality.py --captures ditch stone_sign --keep scenes --fit-steps 1500

Captures are names in ../shared/data; their images/ are taken as bare photos. Positions are compared
after the similarity that fits best, rotations after the rotation that fits best; up is compared
with the up that the reader finds from the given poses.

With --exif the photos are copies: GPS places at the given cameras (in the given scene's metres,
with an error of 0.5 % of the extent on each axis), every third stored on its side with the tag that
turns it, every fourth at three quarters of the size. `scale` then is the found scene's metres over
the given ones.

With --fit-steps a field is fitted by as many steps to the given poses, to the found ones with the
photos as they are (the capture's COLMAP model before undistortion, so the same pixels), and to the
found scene (undistorted pictures); each is measured on its held-out photos, the same ones.
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

HOME = (47.3769, 8.5417)  # degrees, where the copies are said to be taken
GPS_NOISE = 0.005  # of the extent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--captures", nargs="+", default=["ditch", "stone_sign"])
    parser.add_argument("--keep", type=Path, help="folder for the scenes; default: thrown away")
    parser.add_argument("--exif", action="store_true", help="copies with GPS, turned, of two sizes")
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
            row |= compared(given, load_scene(out))
            if options.fit_steps:
                same = Path(temporary) / f"{name}-same"
                model = str(out / "work" / "chosen")
                command("capture", str(photos), "--from-colmap", model, "-o", str(same))
                scenes = {"given": CAPTURES / name, "found": same, "found, undistorted": out}
                row["heldout"] = {
                    poses: fitted(scene, Path(temporary) / f"{name}-{poses}", options)
                    for poses, scene in scenes.items()
                }
            rows.append(row)
    question = "poses from bare photos against given ones"
    report(question + (", copies with EXIF" if options.exif else ""), rows, options.seed)


def copies(given: Scene, folder: Path, seed: int) -> Path:
    """Photos of a scene with GPS, some turned, some smaller; see above."""
    rng = np.random.default_rng(seed)
    folder.mkdir()
    places = np.stack([given.c2w_world(view)[:3, 3] for view in given.views])
    noise = GPS_NOISE * np.linalg.norm(np.ptp(places, axis=0))
    north_m = 111132.954 - 559.822 * math.cos(2 * math.radians(HOME[0]))
    east_m = 111412.84 * math.cos(math.radians(HOME[0]))
    for number, (view, place) in enumerate(zip(given.views, places, strict=True)):
        x, y = place[:2] + noise * rng.normal(size=2)
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


def fitted(scene: Path, run: Path, options: argparse.Namespace) -> dict:
    """Quality of a fit of so many steps on held-out photos."""
    words = ["--steps", str(options.fit_steps), "--minutes", "60", "--seed", str(options.seed)]
    command("fit", str(scene), "-o", str(run), *words)
    measured = json.loads((run / "metrics.json").read_text())
    return {key: measured[key] for key in ("psnr", "psnr_cc", "ssim", "steps", "seconds")}


def compared(given: Scene, found: Scene) -> dict:
    """Registered share, and how far positions, rotations, up and scale are from the given ones."""
    by_stem = {Path(view.name).stem: view for view in given.views}
    own = np.stack([found.c2w_world(view) for view in found.views])
    true = np.stack([given.c2w_world(by_stem[Path(view.name).stem]) for view in found.views])
    a, b = own[:, :3, 3], true[:, :3, 3]
    turn, stretch = rotation_of((b - b.mean(0)).T @ (a - a.mean(0)))
    scale = stretch / ((a - a.mean(0)) ** 2).sum()
    away = np.linalg.norm(scale * (a - a.mean(0)) @ turn.T - (b - b.mean(0)), axis=-1)
    extent = np.linalg.norm(np.ptp(b, axis=0))
    turn, _ = rotation_of((true[:, :3, :3] @ own[:, :3, :3].transpose(0, 2, 1)).sum(0))
    between = turn @ own[:, :3, :3] @ true[:, :3, :3].transpose(0, 2, 1)
    cosine = (np.trace(between, axis1=1, axis2=2) - 1) / 2
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return {
        "registered": len(found.views),
        "pictures": len(given.views),
        "position_percent_of_extent": {
            "median": float(100 * np.median(away) / extent),
            "most": float(100 * away.max() / extent),
        },
        "rotation_degrees": {"median": float(np.median(angle)), "most": float(angle.max())},
        "up_degrees": float(np.degrees(np.arccos(min(1.0, turn[2, 2])))),
        "scale_source": found.scale_source,
        "scale": float(1 / scale),
        "scale_error_told": found.scale_error,
    }


def rotation_of(matrix: np.ndarray) -> tuple[np.ndarray, float]:
    """The rotation nearest to a 3x3 matrix, and the trace of what is left (Umeyama 1991)."""
    u, d, vt = np.linalg.svd(matrix)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return u @ np.diag(sign) @ vt, float((d * sign).sum())


if __name__ == "__main__":
    main()

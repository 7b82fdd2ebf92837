"""How good are poses from bare photos, against a capture's given poses, and how long do they take?

python benchmarks/capture_quality.py --captures ditch stone_sign --keep scenes

Captures are names in ../shared/data; their images/ are taken as bare photos. Positions are compared
after the similarity that fits best, rotations after the rotation that fits best; up is compared
with the up that the reader finds from the given poses.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from common import CAPTURES, command, report

from climatenerf.scene import load_scene, read_scene


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--captures", nargs="+", default=["ditch", "stone_sign"])
    parser.add_argument("--keep", type=Path, help="folder for the scenes; default: thrown away")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        for name in options.captures:
            out = (options.keep or Path(temporary)) / name
            start = time.perf_counter()
            photos = CAPTURES / name / "images"
            command("capture", str(photos), "-o", str(out), "--seed", str(options.seed))
            seconds = time.perf_counter() - start
            rows.append({"capture": name, "seconds": round(seconds, 1), **compared(name, out)})
    report("poses from bare photos against given ones", rows, options.seed)


def compared(name: str, out: Path) -> dict:
    """Registered share, and how far positions, rotations and up are from the given ones."""
    given, found = read_scene(CAPTURES / name), load_scene(out)
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
    }


def rotation_of(matrix: np.ndarray) -> tuple[np.ndarray, float]:
    """The rotation nearest to a 3x3 matrix, and the trace of what is left (Umeyama 1991)."""
    u, d, vt = np.linalg.svd(matrix)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return u @ np.diag(sign) @ vt, float((d * sign).sum())


if __name__ == "__main__":
    main()

"""Folders as `climatenerf compare` writes them, with small pictures of noise."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

from climatenerf.output.video import MovieWriter

METHODS = ("climatenerf", "flat painter", "global MK", "somebody's network", "ARF-9")
"""The first is ours."""


def write_picture(path: Path, seed: int, size: tuple[int, int] = (32, 18)) -> None:
    """Write a smooth random picture as JPEG or PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    coarse = np.random.default_rng(seed).integers(0, 256, (4, 6, 3), np.uint8)
    Image.fromarray(coarse).resize(size, Image.Resampling.BICUBIC).save(path)


def write_movie(path: Path, seed: int, frames: int = 6, size: tuple[int, int] = (32, 18)) -> None:
    """Write a movie of random frames, 12 a second."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draw = np.random.default_rng(seed)
    with MovieWriter(path, size, 12.0) as movie:
        for _ in range(frames):
            colour = draw.integers(0, 256, 3, np.uint8)
            movie.add(np.broadcast_to(colour, (size[1], size[0], 3)).copy())


def write_compare_folder(
    folder: Path,
    scene: str = "ditch",
    methods: tuple[str, ...] = METHODS,
    effects: tuple[str, ...] = ("flood", "snow", "smog"),
    views: int = 2,
    movies: int = 0,
) -> Path:
    """Write a folder in which every method has `views` pictures and `movies` of each effect."""
    items = []
    for effect in effects:
        for number, method in enumerate(methods):
            for kind, suffix, count in (("picture", "jpg", views), ("movie", "mp4", movies)):
                for view in range(count):
                    name = f"{effect}/m{number}/{view}.{suffix}"
                    seed = sum(map(ord, scene + effect)) + 100 * number + view
                    (write_picture if kind == "picture" else write_movie)(folder / name, seed)
                    item = {"method": method, "effect": effect, "kind": kind, "view": str(view)}
                    items.append({**item, "file": name})
    described = [
        {"name": name, "kind": "stand-in" if number else "ours", "licence": None}
        for number, name in enumerate(methods)
    ]
    table = {"schema_version": 1, "scene": scene, "licence": f"photos of {scene}, CC0"}
    (folder / "compare.json").write_text(
        json.dumps({**table, "methods": described, "items": items})
    )
    return folder

"""Write variants of the published street that are as hard as real captures.

    python -m tools.reference_street.variants --out reference/street

Each is a folder beside the street and shares its files where it can. `--only sparse` writes some
alone; `plain` needs the traced group of that name. See docs/reference-scene.md.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from tools.reference_street.layout import heldout_poses
from tools.reference_street.phone import photo
from tools.reference_street.publish import (
    RELIT,
    save_arrays,
    save_text,
    variant_folder,
    weather_file,
    write_list,
    write_sums,
)
from tools.reference_street.render import EXPOSURE, encode
from tools.reference_street.sky import SUN_AZIMUTH, SUN_ELEVATION
from tools.reference_street.tracks import sfm_points
from tools.reference_street.write import mean_of, save_jpeg, save_png, save_portable

if TYPE_CHECKING:
    from climatenerf.scene import Scene

VARIANTS = ("sparse", "tracks", "plain", "hard", "sun", "overcast")
SPARSE_PHOTOS = 20
PLAIN_EXPOSURE = 1.6  # gain of the plain variant's linear pictures: dark photos
PLAIN_QUALITY = 88  # of its JPEGs, with colour at half the resolution
PLAIN_SEED = 3
SKIES = {
    "overcast": ["[sky]", 'kind = "overcast"'],
    "sun": [
        "[sky]",
        'kind = "clear"',
        "[sun]",
        f'elevation = "{SUN_ELEVATION:g} deg"',
        f'azimuth = "{SUN_AZIMUTH:g} deg"',
    ],
}  # what turns one capture into its twin


def write_variants(store: Path, out: Path, only: list[str] | None = None) -> None:
    """Write variants of the street in `out`; `only` names some, default all."""
    write: dict[str, Callable[[], None]] = {
        "sparse": lambda: write_sparse(out),
        "tracks": lambda: write_tracks(store, out),
        "plain": lambda: write_plain(store, out),
        "hard": lambda: write_hard(store, out),
        "sun": lambda: write_lit(store, out, "sun"),
        "overcast": lambda: write_lit(store, out, "overcast"),
    }
    for name in write if only is None else only:
        write[name]()
        write_sums(variant_folder(out, name))


def sparse_names(scene: "Scene") -> set[str]:
    """Return the photos of the sparse variants, evenly spaced along the walk and the arc."""
    names = [view.name for view in scene.of_split("train")]
    chosen = np.round(np.linspace(0, len(names) - 1, SPARSE_PHOTOS)).astype(int)
    return {names[index] for index in chosen}


def write_sparse(out: Path) -> None:
    """Write the variant with few photos, and the points of those photos alone."""
    scene = _fewer_photos(_variant_scene(out, "sparse", out.name))
    seen = [np.empty(0, int) if view.seen is None else view.seen for view in scene.views]
    used = np.unique(np.concatenate(seen))
    assert scene.points is not None
    views = tuple(
        replace(view, seen=np.searchsorted(used, each))
        for view, each in zip(scene.views, seen, strict=True)
    )
    save_portable(replace(scene, views=views, points=scene.points[used]))
    write_list(scene.root, f"../{out.name}", _tests())


def write_tracks(store: Path, out: Path) -> None:
    """Write the variant with points of structure from motion."""
    scene = _variant_scene(out, "tracks", out.name)
    save_portable(_with_sfm_points(scene, store / "tracks"))
    write_list(scene.root, f"../{out.name}", _tests())


def write_plain(store: Path, out: Path) -> None:
    """Write the variant with plain ground, photographed at dusk by a phone."""
    plain = variant_folder(out, "plain")
    scene = _variant_scene(out, "plain", plain.name)
    for index, view in enumerate(scene.views):
        linear = PLAIN_EXPOSURE * mean_of(store / "plain", view.name)
        path = plain / "images" / view.name
        path.parent.mkdir(parents=True, exist_ok=True)
        picture = Image.fromarray(photo(linear, np.random.default_rng([PLAIN_SEED, index])))
        picture.save(path, "JPEG", quality=PLAIN_QUALITY, subsampling="4:2:0")
        if view.split == "heldout":
            truth = plain / "truth" / f"{Path(view.name).stem}.npz"
            save_arrays(truth, clean=linear.astype(np.float16))
    shared = {key: f"../{out.name}/{key}" for key in ("points.ply", "points_seen.npz")}
    save_portable(
        replace(scene, points=None),
        points=shared["points.ply"],
        points_seen=shared["points_seen.npz"],
    )
    write_list(plain, f"../{out.name}", _tests(), clean=".")


def write_hard(store: Path, out: Path) -> None:
    """Write the variant with few photos of plain ground and points found on those photos."""
    plain = variant_folder(out, "plain").name
    scene = _fewer_photos(_variant_scene(out, "hard", plain))
    save_portable(_with_sfm_points(scene, store / "tracks-hard"))
    write_list(scene.root, f"../{out.name}", _tests(), clean=f"../{plain}")


def write_lit(store: Path, out: Path, light: str) -> None:
    """Write the variant under another sky: photos, what is clean, and the deep snow in its light.

    Geometry, labels, points and the layers of the snow are the street's.
    """
    folder = variant_folder(out, light)
    scene = _variant_scene(out, light, folder.name)
    for view in scene.views:
        linear = EXPOSURE * mean_of(store / light, view.name)
        save_jpeg(linear, folder / "images" / view.name)
        if view.split == "heldout":
            truth = folder / "truth" / f"{Path(view.name).stem}.npz"
            save_arrays(truth, clean=linear.astype(np.float16))
            snowy = EXPOSURE * mean_of(store / f"snow-{light}", view.name)
            picture = folder / "weather" / f"snow-{light}" / f"{Path(view.name).stem}.png"
            save_png(encode(snowy), picture)
    shared = {key: f"../{out.name}/{key}" for key in ("points.ply", "points_seen.npz")}
    save_portable(
        replace(scene, points=None),
        points=shared["points.ply"],
        points_seen=shared["points_seen.npz"],
    )
    save_text(folder / "weather" / f"snow-{light}.toml", weather_file(f"snow-{light}"))
    save_text(folder / "relight" / f"{RELIT[light]}.toml", SKIES[RELIT[light]])
    write_list(folder, f"../{out.name}", _tests(), clean=".", light=light)


def _variant_scene(out: Path, variant: str, photos: str) -> "Scene":
    """Return the street's scene for a variant, with the photos of the folder `photos` beside it."""
    from climatenerf.scene import load_scene

    scene, root = load_scene(out), variant_folder(out, variant).resolve()
    root.mkdir(parents=True, exist_ok=True)  # paths through it are opened
    folder = root if photos == root.name else root / ".." / photos
    views = tuple(
        replace(
            view,
            path=folder / "images" / view.name,
            label_path=root / f"../{out.name}/labels/{Path(view.name).stem}.png",
        )
        for view in scene.views
    )
    return replace(scene, root=root, views=views)


def _fewer_photos(scene: "Scene") -> "Scene":
    names = sparse_names(scene)
    views = tuple(view for view in scene.views if view.split == "heldout" or view.name in names)
    return replace(scene, views=views)


def _with_sfm_points(scene: "Scene", work: Path) -> "Scene":
    points, seen = sfm_points(scene.of_split("train"), scene.cameras[0], work)
    found = dict(zip([view.name for view in scene.of_split("train")], seen, strict=True))
    nothing = np.empty(0, int)
    views = tuple(replace(view, seen=found.get(view.name, nothing)) for view in scene.views)
    return replace(scene, points=points, views=views)


def _tests() -> list[str]:
    return [name for name, _ in heldout_poses()]


def main() -> None:
    """Write the requested variants."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.reference_street.variants", description=__doc__
    )
    parser.add_argument("--store", type=Path, default=Path("build/street-reference"))
    parser.add_argument("--out", type=Path, required=True, help="the published street")
    parser.add_argument("--only", nargs="*", choices=VARIANTS, help="default: all")
    args = parser.parse_args()
    write_variants(args.store, args.out, args.only)


if __name__ == "__main__":
    main()

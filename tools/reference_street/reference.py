"""Path trace the reference set.

    python -m tools.reference_street.reference --out reference/street

The store holds the linear mean of every picture in one file, and each pass adds samples to it:
re-run the same command to resume. `--only flood-low` limits the run to some groups. See
docs/reference-scene.md.
"""

import argparse
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from jaxtyping import Float

from tools.reference_street.layout import (
    build_scene,
    camera_poses,
    ground_datum,
    heldout_poses,
    passers_by,
)
from tools.reference_street.mirror import mirrored_view
from tools.reference_street.publish import LEVELS, SNOW, WAVE_TIME, write_reference
from tools.reference_street.render import load, render_view
from tools.reference_street.sky import dusk
from tools.reference_street.smog import air_box, scattering_air
from tools.reference_street.snowfall import snow_meshes
from tools.reference_street.store import add, stored
from tools.reference_street.variants import write_variants
from tools.reference_street.water import still, wavy
from tools.reference_street.write import write_demo

WIDTH, HEIGHT = 384, 216
Poses = list[tuple[str, Float[np.ndarray, "4 4"]]]


@dataclass(frozen=True)
class Group:
    """Pictures that are traced with the same settings.

    Attributes:
        name: folder in the store.
        poses: names and poses of the views.
        samples: samples per pixel and pass; a square number.
        passes: number of passes to average.
    """

    name: str
    poses: Poses
    samples: int
    passes: int


def groups() -> list[Group]:
    """Return all groups, the expensive ones last; their samples give 37 to 42 dB of noise."""
    test = heldout_poses()
    walk = [pose for i, pose in enumerate(camera_poses()) if passers_by(i)]
    return [
        Group("clean", test + camera_poses(), 49, 2),
        Group("flood-high", test, 100, 4),
        Group("flood-low", test, 100, 2),
        Group("flood-waves", test, 100, 2),
        Group("snow-deep", test, 49, 2),
        Group("snow-thin", test, 49, 2),
        Group("mirror", test, 36, 1),
        Group("people", walk, 49, 2),
        Group("clean", test, 49, 3),
        Group("scattering", test[:1], 25, 1),
        # The photos receive far more noise afterwards than 25 samples leave.
        Group("plain", test + camera_poses(), 25, 1),
        Group("plain", test, 25, 6),
    ]


def open_group(group: Group, view: int, folder: Path, threads: int):
    """Return the Mitsuba scene of a group for one of its views, and the medium of its air."""
    mi.set_variant("scalar_rgb")
    plain = group.name == "plain"
    meshes, water, air, datum = build_scene(plain), None, None, ground_datum()[0]
    if group.name in ("flood-low", "flood-high"):
        water = still(datum + LEVELS[group.name])
    if group.name == "flood-waves":
        water = wavy(datum + LEVELS[group.name], WAVE_TIME, folder)
    if group.name == "scattering":
        air = mi.load_dict(scattering_air())
        water = air_box(air)
    if group.name in SNOW:
        meshes += snow_meshes(meshes, SNOW[group.name])
    if group.name == "people":
        meshes += passers_by(view)
    return load(meshes, folder, threads, water, sky=dusk() if plain else None), air


def trace(group: Group, store: Path, threads: int) -> None:
    """Add the missing passes of a group to the store."""
    names = [name for name, _ in camera_poses()]
    folder = store / group.name
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        opened = None
        for number in range(group.passes):
            for index, (name, pose) in enumerate(group.poses):
                path = (folder / name).with_suffix(".npz")
                if stored(path)[0] > number:
                    continue
                if opened is None or group.name == "people":
                    view = names.index(name) if name in names else index
                    opened = open_group(group, view, Path(scratch), threads)
                start = time.monotonic()
                seed = 1000 * number + index
                scene, air = opened
                if group.name == "mirror":
                    level = ground_datum()[0] + LEVELS["flood-high"]
                    size = (WIDTH, HEIGHT)
                    fresh = mirrored_view(scene, pose, level, size, group.samples, seed)
                else:
                    fresh = render_view(scene, pose, WIDTH, HEIGHT, group.samples, seed, air=air)
                add(path, fresh[..., :3])
                seconds = time.monotonic() - start
                print(f"{group.name} pass {number} {name} {seconds:.1f} s", flush=True)


def main() -> None:
    """Trace the missing pictures of each group, and write the requested folders."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.reference_street.reference", description=__doc__
    )
    parser.add_argument("--store", type=Path, default=Path("build/street-reference"))
    parser.add_argument("--only", nargs="*", help="groups; default: all")
    parser.add_argument("--out", type=Path, help="write the reference set into this folder")
    parser.add_argument("--demo", type=Path, help="write the demo's subset into this folder")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    for group in groups():
        if args.only is None or group.name in args.only:
            trace(group, args.store, args.threads)
    if args.demo:
        write_demo(args.store, args.demo, WIDTH, HEIGHT)
    if args.out:
        write_reference(args.store, args.out, WIDTH, HEIGHT)
        write_variants(args.store, args.out)


if __name__ == "__main__":
    main()

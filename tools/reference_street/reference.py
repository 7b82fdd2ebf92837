"""Path trace the reference set.

    python -m tools.reference_street.reference --out reference/street

The store holds the linear mean of every picture in one file. Passes add samples to it until its
noise is low enough: re-run the same command to resume. `--only flood-low` limits the run to some
groups. See docs/reference-scene.md.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
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
from tools.reference_street.render import EXPOSURE, load, render_view
from tools.reference_street.sky import clear, dusk, environment, overcast
from tools.reference_street.smog import air_box, scattering_air, smoggy_view
from tools.reference_street.snowfall import snow_meshes
from tools.reference_street.store import add, noise_db, stored
from tools.reference_street.variants import VARIANTS, write_variants
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
        noise: PSNR of the noise that ends a picture's passes, dB.
        light: a key of `LIGHTS`.
        snow: depth of snow, m.
    """

    name: str
    poses: Poses
    samples: int
    noise: float
    light: str = "cloudy"
    snow: float = 0.0


LIGHTS: dict[str, Callable[[], np.ndarray | dict]] = {
    "cloudy": environment,
    "dusk": dusk,
    "overcast": overcast,
    "sun": clear,
}
MAX_PASSES = 64


def groups() -> list[Group]:
    """Return all groups, the expensive ones last."""
    test, photos = heldout_poses(), camera_poses()
    walk = [pose for i, pose in enumerate(photos) if passers_by(i)]
    return [
        Group("clean", test, 49, 43.5),
        Group("smog", test, 25, 40.0),
        Group("clean", photos, 49, 41.0),
        Group("sun", test, 49, 43.5, "sun"),
        Group("overcast", test, 49, 43.5, "overcast"),
        Group("sun", photos, 49, 40.0, "sun"),
        Group("overcast", photos, 49, 40.0, "overcast"),
        Group("snow-deep", test, 49, 40.0, snow=SNOW["snow-deep"]),
        Group("snow-thin", test, 49, 40.0, snow=SNOW["snow-thin"]),
        Group("snow-sun", test, 49, 40.0, "sun", SNOW["snow-deep"]),
        Group("snow-overcast", test, 49, 40.0, "overcast", SNOW["snow-deep"]),
        Group("flood-waves", test, 100, 36.0),
        Group("flood-mud", test, 100, 34.5),
        Group("flood-high", test, 100, 37.0),
        Group("flood-low", test, 100, 37.0),
        Group("mirror", test, 16, 38.0),
        Group("smog-scattering", test, 36, 34.0),
        Group("people", walk, 49, 41.0),
        # The photos receive far more noise afterwards than 25 samples leave.
        Group("plain", test, 25, 42.0, "dusk"),
        Group("plain", photos, 25, 0.0, "dusk"),
    ]


def open_group(group: Group, view: int, folder: Path, threads: int, variant: str):
    """Return the Mitsuba scene of a group for one of its views, and the medium of its air."""
    mi.set_variant(variant)
    meshes, water, air, datum = build_scene(group.name == "plain"), None, None, ground_datum()[0]
    if group.name in LEVELS:
        level = datum + LEVELS[group.name]
        waves = group.name == "flood-waves"
        water = wavy(level, WAVE_TIME, folder) if waves else still(level, group.name == "flood-mud")
    if group.name == "smog-scattering":
        air = mi.load_dict(scattering_air())
        water = air_box(air)
    if group.snow:
        meshes += snow_meshes(meshes, group.snow)
    if group.name == "people":
        meshes += passers_by(view)
    return load(meshes, folder, threads, water, sky=LIGHTS[group.light](), variant=variant), air


def trace(group: Group, store: Path, threads: int, variant: str) -> None:
    """Add passes to the pictures of a group until their noise is low enough."""
    if group.name in ("mirror", "smog"):
        variant = "scalar_rgb"  # they sample path by path
    names = [name for name, _ in camera_poses()]
    folder = store / group.name
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        opened = None
        for number in range(MAX_PASSES):
            for index, (name, pose) in enumerate(group.poses):
                path = (folder / name).with_suffix(".npz")
                passes = stored(path)[0]
                enough = passes >= 1 if not group.noise else noise_db(path, EXPOSURE) >= group.noise
                if passes > number or enough:
                    continue
                if opened is None or group.name == "people":
                    view = names.index(name) if name in names else index
                    opened = open_group(group, view, Path(scratch), threads, variant)
                start = time.monotonic()
                seed, size = 1000 * number + index, (WIDTH, HEIGHT)
                scene, air = opened
                if group.name == "mirror":
                    level = ground_datum()[0] + LEVELS["flood-high"]
                    fresh = mirrored_view(scene, pose, level, size, group.samples, seed)
                elif group.name == "smog":
                    base = ground_datum()[0]
                    fresh = smoggy_view(scene, pose, base, size, group.samples, seed)
                else:
                    fresh = render_view(scene, pose, *size, group.samples, seed, air=air)[..., :3]
                add(path, fresh)
                seconds, noise = time.monotonic() - start, noise_db(path, EXPOSURE)
                print(f"{group.name} {name} {number} {seconds:.1f} s {noise:.1f} dB", flush=True)


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
    parser.add_argument(
        "--llvm", action="store_true", help="trace with LLVM (16 may fail; 19 works): twice as fast"
    )
    args = parser.parse_args()
    for group in groups():
        if args.only is None or group.name in args.only:
            trace(group, args.store, args.threads, "llvm_ad_rgb" if args.llvm else "scalar_rgb")
    if args.demo:
        write_demo(args.store, args.demo, WIDTH, HEIGHT)
    if args.out:
        write_reference(args.store, args.out, WIDTH, HEIGHT, args.only)
        wanted = [name for name in VARIANTS if args.only is None or name in args.only]
        write_variants(args.store, args.out, wanted)


if __name__ == "__main__":
    main()

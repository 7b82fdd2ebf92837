"""Write the reference set: views, classes, truth, weather, checksums; the busy and turned variants.

docs/reference-scene.md describes the files.
"""

import hashlib
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tools.reference_street import smog, water
from tools.reference_street.layout import (
    build_scene,
    camera_poses,
    ground_datum,
    heldout_poses,
    passers_by,
)
from tools.reference_street.render import EXPOSURE, encode, load
from tools.reference_street.sky import (
    CLEAR_SHEET,
    SUN_AZIMUTH,
    SUN_ELEVATION,
    environment,
    overcast,
)
from tools.reference_street.snowfall import snow_meshes
from tools.reference_street.truth import layers, snow_layers
from tools.reference_street.write import (
    mean_of,
    save_jpeg,
    save_png,
    truths,
    write_pictures,
    write_scene,
)

SNOW = {"snow-thin": 0.03, "snow-deep": 0.15}  # m
SNOW_ALBEDO = 0.87  # of the paint "snow" of `textures`
LEVELS = {
    "flood-low": 0.25,
    "flood-high": 0.6,
    "flood-waves": 0.6,
    "flood-mud": 0.6,
}  # m above the ground datum
RELIT = {"sun": "overcast", "overcast": "sun"}  # captures under another sky, and their twins
MAX_THICKNESS = 3.0  # times the depth in the open; overhanging snow is thicker
WAVE_TIME = 1.0  # s
EXPOSURE_SPREAD = 0.12  # standard deviation of the busy variant's log exposure
TURN = ((0.5, -0.7, 0.4), 40.0)  # axis and angle (degrees) of the turned variant
SHRUNK, SHIFT = 0.37, (12.0, -5.0, 3.0)  # its units per metre, and its translation, units


def write_reference(
    store: Path, out: Path, width: int, height: int, only: list[str] | None = None
) -> None:
    """Write the reference set to `out`, and its variants to `out`-busy and `out`-turned.

    `only` names groups of pictures, and leaves the files of other groups as they are.
    """

    def wanted(name: str) -> bool:
        return only is None or name in only

    if wanted("clean"):
        write_capture(store, out, width, height)
    if wanted("smog"):
        write_smog(store, out)
    for name, _ in heldout_poses():
        stem = Path(name).stem
        for group in filter(wanted, (*LEVELS, *SNOW, "smog-scattering")):
            linear = EXPOSURE * mean_of(store / group, name)
            save_png(encode(linear), out / "weather" / group / f"{stem}.png")
        if wanted("mirror"):
            linear = EXPOSURE * mean_of(store / "mirror", name)
            save_arrays(out / "mirror" / f"{stem}.npz", linear=linear.astype(np.float16))
    write_snow_truth(store, out, width, height, [kind for kind in SNOW if wanted(kind)])
    write_weather_files(out)
    write_list(out, ".", [name for name, _ in heldout_poses()])
    if wanted("people"):
        write_busy(store, out, width, height)
    if wanted("clean"):
        write_turned(out)
    for folder in (out, variant_folder(out, "busy"), variant_folder(out, "turned")):
        write_sums(folder)


def write_capture(store: Path, out: Path, width: int, height: int) -> None:
    """Write photos, labels, scene and the truth of the dry test views."""
    tests = heldout_poses()
    poses = camera_poses() + tests
    write_pictures(store / "clean", out / "images", poses)
    known = truths(store, poses, width, height)
    for name, truth in known.items():
        save_png(truth["label"], out / "labels" / f"{Path(name).stem}.png")
    write_scene(out, poses, {name for name, _ in tests}, known, width, height)
    for name, _ in tests:
        truth, clean = known[name], EXPOSURE * mean_of(store / "clean", name)
        save_arrays(
            out / "truth" / f"{Path(name).stem}.npz",
            depth=truth["depth"],
            normal=truth["normal"].astype(np.float16),
            sun=truth["sun"].astype(np.float16),
            clean=clean.astype(np.float16),
        )


def write_smog(store: Path, out: Path) -> None:
    """Write pictures and transmittances of the smog with a constant airlight."""
    for name, _ in heldout_poses():
        through = mean_of(store / "smog", name)
        for kind in smog.VISIBILITY:
            picture, passed = smog.smoggy(through, kind, EXPOSURE)
            path = out / "weather" / kind / f"{Path(name).stem}.png"
            save_png(encode(picture), path)
            save_arrays(path.with_suffix(".npz"), transmittance=passed.astype(np.float16))


def variant_folder(out: Path, variant: str) -> Path:
    """Return the folder of a variant of the set in `out`."""
    return out.with_name(f"{out.name}-{variant}")


def write_snow_truth(store: Path, out: Path, width: int, height: int, kinds: Sequence[str]) -> None:
    """Write depth and thickness of the snow in the test views; the store caches them."""
    meshes = build_scene()
    (store / "layers").mkdir(parents=True, exist_ok=True)
    for kind in kinds:
        depth = SNOW[kind]
        limit = MAX_THICKNESS * depth
        with tempfile.TemporaryDirectory() as scratch:
            scenes = None
            for name, pose in heldout_poses():
                cached = (store / "layers" / f"{kind}-{name}").with_suffix(".npz")
                if not cached.exists():
                    if scenes is None:
                        whole = meshes + snow_meshes(meshes, depth)
                        snowy = load(whole, Path(scratch), named=True)
                        scenes = snowy, load(meshes, Path(scratch))
                    np.savez(cached, **snow_layers(*scenes, pose, width, height))
                with np.load(cached) as data:
                    save_arrays(
                        out / "weather" / kind / f"{Path(name).stem}.npz",
                        depth=data["depth"],
                        # At edges the snow overhangs its support by half a cell.
                        thickness=np.minimum(data["thickness"], limit).astype(np.float16),
                    )


def write_weather_files(out: Path) -> None:
    """Write the weather file of each weather."""
    for kind in (*smog.VISIBILITY, "smog-scattering", *LEVELS, *SNOW):
        save_text(out / "weather" / f"{kind}.toml", weather_file(kind))


def weather_file(kind: str) -> list[str]:
    """Return the lines of a weather file: what was put into the street, in the program's words."""
    sun = [
        "[sun]",
        f'elevation = "{SUN_ELEVATION:g} deg"',
        f'azimuth = "{SUN_AZIMUTH:g} deg"',
    ]
    if kind in smog.VISIBILITY:
        lines = ["[smog]", f'visibility = "{smog.VISIBILITY[kind]:g} m"']
        lines += ['light = "paper"', f"colour = {list(smog.COLOUR)}"]
        if kind in smog.FALLOFF:
            lines.append(f'height-falloff = "{smog.FALLOFF[kind]:g} m"')
        return lines + sun
    if kind == "smog-scattering":
        return [
            "[smog]", f'visibility = "{smog.VISIBILITY["smog-mid"]:g} m"',
            f"albedo = {list(smog.ALBEDO)}", f"asymmetry = {smog.ASYMMETRY}",
            f'top = "{smog.TOP - ground_datum()[0]:g} m"', *sun,
        ]  # fmt: skip
    if kind in LEVELS:
        mud = kind == "flood-mud"
        colour = water.mud_colour() if mud else (0.0, 0.0, 0.0)
        attenuation = water.mud_extinction() if mud else 3 * [water.ABSORPTION]
        return [
            f"seed = {water.SEED}", "[flood]", f'level = "{LEVELS[kind]:g} m"',
            f'wind-speed = "{water.WIND if kind == "flood-waves" else 0.0:g} m/s"',
            f"wave-scale = {water.WAVE_SCALE}", f'spreading = "{water.SPREADING}"',
            'wet-band = "0 m"',  # the true shore is dry down to the waterline
            f"colour = {[round(float(value), 3) for value in colour]}",
            f"attenuation = {[round(float(value), 3) for value in attenuation]}",
            f"ior = {water.IOR}", "gloss = 1e9", *sun,
        ]  # fmt: skip
    depth = SNOW.get(kind, SNOW["snow-deep"])
    # The true snow is a white sheet without a fraction that lets light through.
    own = ["[snow]", f'depth = "{depth:g} m"', f"albedo = {SNOW_ALBEDO}", 'grain = "0.03 mm"']
    return [*own, *([] if kind == "snow-overcast" else sun)]


def write_list(
    out: Path,
    truth: str,
    views: list[str],
    clean: str | None = None,
    light: str | None = None,
) -> None:
    """Write reference.json: the test views, the weathers and the folder of the truth.

    `clean` is the folder of the clean pictures of a variant with a light of its own. Such a variant
    has no pictures in the street's weathers. One of a `light` in `RELIT` has deep snow, and is
    compared with the other one.
    """
    kinds = [*smog.VISIBILITY, "smog-scattering", *LEVELS, *SNOW]
    data: dict = {
        "schema_version": 3,
        "truth": truth,
        "views": views,
        "weather": {k: {"time_s": WAVE_TIME if k == "flood-waves" else 0.0} for k in kinds},
        "mirror_level_m": LEVELS["flood-high"],
    }
    data["light"] = {"sheet": sheet(light or "cloudy"), "sun_deg": None}
    if light == "sun":
        data["light"]["sun_deg"] = [SUN_ELEVATION, SUN_AZIMUTH]
    if clean is not None:
        data |= {"clean": clean, "weather": {}, "mirror_level_m": None}
        if light is None:  # of dusk, which is not stated
            data["light"] = None
    if light is not None:
        snow = {"time_s": 0.0, "folder": ".", "layers": "snow-deep"}
        data["weather"] = {f"snow-{light}": snow}
        data["relight"] = {RELIT[light]: f"../{variant_folder(Path(truth), RELIT[light]).name}"}
    save_text(out / "reference.json", [json.dumps(data, indent=1)])


def sheet(light: str) -> list[float]:
    """Return the exposed radiance of a white sheet on open level ground under one of the skies."""
    if light == "sun":
        radiance = CLEAR_SHEET
    else:
        sky = {"cloudy": environment, "overcast": overcast}[light]()
        rows = (np.arange(len(sky)) + 0.5) * np.pi / len(sky)
        ring = 2 * np.pi / sky.shape[1] * np.pi / len(sky) * np.sin(rows)
        weights = ring * np.maximum(np.cos(rows), 0.0) / np.pi
        radiance = np.einsum("r,rac->c", weights, sky)
    return [round(float(EXPOSURE * value), 4) for value in radiance]


def write_busy(store: Path, out: Path, width: int, height: int) -> None:
    """Write the variant with people and a random exposure of each picture."""
    walk, tests = camera_poses(), heldout_poses()
    known = truths(store, walk + tests, width, height)
    busy, rng = variant_folder(out, "busy"), np.random.default_rng(5)
    meshes = build_scene()
    changed = set()
    for index, (name, pose) in enumerate(walk):
        people = passers_by(index)
        linear = mean_of(store / ("people" if people else "clean"), name)
        gain = EXPOSURE * np.exp(EXPOSURE_SPREAD * rng.standard_normal())
        save_jpeg(gain * linear, busy / "images" / name)
        if people:
            cached = (store / "layers" / f"people-{name}").with_suffix(".npz")
            if not cached.exists():
                with tempfile.TemporaryDirectory() as scratch:
                    scene = load(meshes + people, Path(scratch), named=True)
                    np.savez(cached, **layers(scene, meshes + people, pose, width, height))
            with np.load(cached) as data:
                save_png(data["label"], busy / "labels" / f"{Path(name).stem}.png")
            changed.add(f"labels/{Path(name).stem}.png")
        changed.add(f"images/{name}")

    def shared(path: str) -> str:
        return path if path in changed else f"../{out.name}/{path}"

    heldout = {name for name, _ in tests}
    write_scene(busy, walk + tests, heldout, known, width, height, shared)
    write_list(busy, f"../{out.name}", [name for name, _ in tests])


def write_turned(out: Path) -> None:
    """Write the variant without known up and scale: transforms.json in a rotated frame."""
    from climatenerf.scene import load_scene
    from climatenerf.scene.readers.ply import write_points

    turned = variant_folder(out, "turned")
    scene = load_scene(out)
    camera = scene.cameras[0]
    similarity = np.eye(4)
    similarity[:3, :3] = SHRUNK * _rotation(*TURN)
    similarity[:3, 3] = SHIFT
    frames = []
    for view in scene.views:
        pose = similarity @ view.c2w
        pose[:3, :3] /= SHRUNK
        opengl = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
        path = f"../{out.name}/images/{view.name}"
        frames.append({"file_path": path, "transform_matrix": opengl.tolist()})
    listed = {
        split: [f"../{out.name}/images/{view.name}" for view in scene.of_split(split)]
        for split in ("train", "heldout")
    }
    data = {
        "camera_model": "PINHOLE",
        "w": camera.width, "h": camera.height,
        "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy,
        "ply_file_path": "points.ply",
        "train_filenames": listed["train"], "test_filenames": listed["heldout"],
        "frames": frames,
    }  # fmt: skip
    save_text(turned / "transforms.json", [json.dumps(data, indent=1)])
    assert scene.points is not None
    write_points(turned / "points.ply", scene.points @ similarity[:3, :3].T + similarity[:3, 3])
    write_list(turned, f"../{out.name}", [view.name for view in scene.of_split("heldout")])


def write_sums(out: Path) -> None:
    """Write SHA256SUMS of all files in the format of sha256sum."""
    lines = [
        f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.relative_to(out).as_posix()}"
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.name != "SHA256SUMS"
    ]
    save_text(out / "SHA256SUMS", lines)


def _rotation(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    """Return the rotation matrix of an axis and an angle by Rodrigues' formula."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    a = np.deg2rad(degrees)
    return np.eye(3) + np.sin(a) * cross + (1 - np.cos(a)) * cross @ cross


def save_arrays(path: Path, **arrays: np.ndarray) -> None:
    """Write arrays as NPZ."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays)


def save_text(path: Path, lines: list[str]) -> None:
    """Write lines of text."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")

"""Path trace the street: `python -m street.render --out FOLDER [--views ..] [--spp ..] ...`.

Samples come in passes over all views; a view's linear mean so far is one file in the store, so
an interrupted run continues where it stopped, and every pass leaves a usable set in OUT/images.
`--passes 0` writes only labels, scene.json and points.ply.
"""

import argparse
import json
import os
import tempfile
import time
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from PIL import Image

from street.geometry import Mesh
from street.layout import FIELD_OF_VIEW, build_scene, camera_poses, ground_datum
from street.sky import environment
from street.textures import make

EXPOSURE = 0.85  # one gain for all views: most pixels then lie in [0, 1]
JPEG_QUALITY = 92
SKY, UNKNOWN = 10, 255  # Cityscapes train ids
HOLDOUT_EVERY = 8  # the first, ninth, ... view by name is held out


def encode(linear: Float[np.ndarray, "h w 3"]) -> np.ndarray:
    """Linear radiance → 8-bit sRGB."""
    x = np.clip(linear, 0, 1)
    srgb = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-8) ** (1 / 2.4) - 0.055)
    return np.round(255 * srgb).astype(np.uint8)


def write_ply(mesh: Mesh, path: Path) -> None:
    """Binary PLY with texture coordinates, and vertex normals where the mesh is smooth."""
    fields = ["x", "y", "z"]
    columns = [mesh.vertices]
    if mesh.smooth:
        fields += ["nx", "ny", "nz"]
        columns.append(vertex_normals(mesh))
    fields += ["u", "v"]
    columns.append(mesh.uv)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
    header += [f"property float {f}" for f in fields]
    header += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices"]
    faces = np.empty(len(mesh.faces), dtype=[("n", "u1"), ("i", "<i4", 3)])
    faces["n"], faces["i"] = 3, mesh.faces
    with path.open("wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode())
        file.write(np.concatenate(columns, axis=1).astype("<f4").tobytes())
        file.write(faces.tobytes())


def vertex_normals(mesh: Mesh) -> Float[np.ndarray, "n 3"]:
    """Area-weighted normals; vertices at one place (seams, poles) share theirs."""
    corners = mesh.vertices[mesh.faces]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    _, group = np.unique(np.round(mesh.vertices, 5), axis=0, return_inverse=True)
    group = group.reshape(-1)
    total = np.zeros((group.max() + 1, 3))
    for k in range(3):
        np.add.at(total, group[mesh.faces[:, k]], face)
    normals = total[group]
    # A vertex all of whose triangles are degenerate has no normal; up is as good as any.
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.where(length > 1e-12, normals / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])


def load(meshes: list[Mesh], folder: Path, threads: int = 1):
    """The Mitsuba scene of diffuse, textured meshes under the sky; PLY files go to `folder`."""
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    dr.set_thread_count(threads)
    scene = {"type": "scene", "integrator": {"type": "path", "max_depth": 5}}
    textures = {}
    for mesh in meshes:
        if mesh.texture not in textures:
            bitmap = mi.Bitmap(make(mesh.texture))
            textures[mesh.texture] = {
                "type": "twosided",
                "bsdf": {
                    "type": "diffuse",
                    "reflectance": {"type": "bitmap", "bitmap": bitmap, "filter_type": "bilinear"},
                },
            }
            textures[mesh.texture] = mi.load_dict(textures[mesh.texture])
        path = folder / f"{mesh.name}.ply"
        write_ply(mesh, path)
        scene[mesh.name.replace(".", "_")] = {
            "type": "ply",
            "filename": str(path),
            "face_normals": not mesh.smooth,
            "bsdf": textures[mesh.texture],
        }
    rotate = mi.ScalarTransform4f().rotate([1, 0, 0], 90)  # the sky's up is y; ours is z
    bitmap = mi.Bitmap(environment().astype(np.float32))
    scene["sky"] = {"type": "envmap", "bitmap": bitmap, "to_world": rotate}
    return mi.load_dict(scene)


def render_view(
    scene,
    pose: Float[np.ndarray, "4 4"],
    width: int,
    height: int,
    spp: int,
    seed: int,
    integrator=None,
):
    """Linear radiance of one view before exposure and coverage by matter, [height, width, 4]."""
    import mitsuba as mi

    # Mitsuba's camera looks along +z with +x to the left and +y up.
    to_world = mi.ScalarTransform4f((pose @ np.diag([-1.0, -1.0, 1.0, 1.0])).tolist())
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": FIELD_OF_VIEW,
            "fov_axis": "x",
            "near_clip": 0.05,
            "far_clip": 2000.0,
            "to_world": to_world,
            "sampler": {"type": "multijitter", "sample_count": spp},
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "pixel_format": "rgba",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
        }
    )
    return np.array(mi.render(scene, integrator=integrator, sensor=sensor, spp=spp, seed=seed))


def write_labels(scene, folder: Path, width: int, height: int, spp: int = 16) -> None:
    """Label maps in Cityscapes train ids: sky where nothing covers a pixel, else unknown."""
    import mitsuba as mi

    folder.mkdir(parents=True, exist_ok=True)
    first_hit = mi.load_dict({"type": "path", "max_depth": 2, "hide_emitters": True})
    for name, pose in camera_poses():
        covered = render_view(scene, pose, width, height, spp, 0, first_hit)[..., 3]
        label = np.where(covered == 0, SKY, UNKNOWN).astype(np.uint8)
        Image.fromarray(label).save((folder / name).with_suffix(".png"), optimize=True)


def _save_jpeg(picture: np.ndarray, path: Path) -> None:
    temporary = path.with_suffix(".tmp")
    Image.fromarray(picture).save(temporary, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    os.replace(temporary, path)


def sparse_points(
    scene, width: int, height: int, per_view: int = 48, farthest: float = 120.0
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"]]:
    """Surface points as structure from motion would give them, metres, and the view of each."""
    import mitsuba as mi

    rng = np.random.default_rng(1)
    focal = 0.5 * width / np.tan(np.deg2rad(0.5 * FIELD_OF_VIEW))
    points, seen_by = [], []
    for i, (_, pose) in enumerate(camera_poses()):
        pixel = rng.uniform(size=(per_view, 2)) * [width, height]
        local = np.c_[(pixel - 0.5 * np.array([width, height])) / focal, np.ones(per_view)]
        rays = local @ pose[:3, :3].T
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        for ray in rays:
            hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(*pose[:3, 3]), mi.Vector3f(*ray)))
            if hit.is_valid() and hit.t < farthest:
                points.append(pose[:3, 3] + float(hit.t) * ray)
                seen_by.append(i)
    return np.array(points), np.array(seen_by)


def write_scene(
    out: Path,
    width: int,
    height: int,
    points: Float[np.ndarray, "n 3"],
    seen_by: Int[np.ndarray, "n"],
) -> None:
    """Write scene.json (and points.ply) beside the pictures with climatenerf's own writer."""
    from climatenerf.scene import Camera, Scene, View, save_scene

    focal = 0.5 * width / np.tan(np.deg2rad(0.5 * FIELD_OF_VIEW))
    camera = Camera(width, height, focal, focal, 0.5 * width, 0.5 * height)
    ground, lowest = ground_datum()
    root = out.resolve()
    views = tuple(
        View(
            name,
            root / "images" / name,
            0,
            pose,
            "heldout" if i % HOLDOUT_EVERY == 0 else "train",
            label_path=root / "labels" / Path(name).with_suffix(".png"),
            seen=np.flatnonzero(seen_by == i),
        )
        for i, (name, pose) in enumerate(camera_poses())
    )
    scene = Scene(root, "street", (camera,), views, points, ground_z=ground, lowest_ground_z=lowest)
    path = save_scene(scene, root)
    # The folder travels with its scene.json, so where it was made is nobody's business.
    data = json.loads(path.read_text(encoding="utf-8"))
    data.pop("root_absolute", None)
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(data, indent=1), encoding="utf-8")
    os.replace(temporary, path)


def _accumulate(path: Path, fresh: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Average a new pass into the view's stored mean; returns the mean."""
    passes, mean = _stored(path)
    mean = fresh if mean is None else (passes * mean + fresh) / (passes + 1)
    temporary = path.with_name(path.stem + ".tmp.npz")
    np.savez(temporary, mean=mean.astype(np.float32), passes=passes + 1)
    os.replace(temporary, path)
    return mean


def _stored(path: Path) -> tuple[int, Float[np.ndarray, "h w 3"] | None]:
    if not path.exists():
        return 0, None
    with np.load(path) as data:
        return int(data["passes"]), data["mean"]


def main() -> None:
    """Render the wanted views pass by pass, then write scene.json if every view is there."""
    parser = argparse.ArgumentParser(prog="python -m street.render", description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--views", nargs="*", help="image names, e.g. 0001.jpg (default: all)")
    parser.add_argument("--spp", type=int, default=49, help="samples per pixel and pass")
    parser.add_argument("--passes", type=int, default=2)
    parser.add_argument("--store", type=Path, default=Path("build/street"), help="linear means")
    parser.add_argument("--size", default="384x216")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    width, height = (int(n) for n in args.size.split("x"))
    images, linear = args.out / "images", args.store
    images.mkdir(parents=True, exist_ok=True)
    linear.mkdir(parents=True, exist_ok=True)
    every = camera_poses()
    with tempfile.TemporaryDirectory() as scratch:
        scene = load(build_scene(), Path(scratch), args.threads)
        for number in range(args.passes):
            for i, (name, pose) in enumerate(every):
                store = (linear / name).with_suffix(".npz")
                if (args.views and name not in args.views) or _stored(store)[0] > number:
                    continue
                start = time.monotonic()
                seed = 1000 * number + i
                fresh = render_view(scene, pose, width, height, args.spp, seed)[..., :3]
                mean = _accumulate(store, fresh)
                _save_jpeg(encode(EXPOSURE * mean), images / name)
                over = float((EXPOSURE * mean > 1).any(-1).mean())
                took = time.monotonic() - start
                print(f"pass {number} {name} {took:.1f} s, {over:.1%} over 1", flush=True)
        if all((images / name).exists() for name, _ in every):
            write_labels(scene, args.out / "labels", width, height)
            write_scene(args.out, width, height, *sparse_points(scene, width, height))


if __name__ == "__main__":
    main()

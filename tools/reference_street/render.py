"""The street as a Mitsuba scene: meshes, textures, sky, cameras; linear pictures."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from tools.reference_street.geometry import Mesh
from tools.reference_street.layout import FIELD_OF_VIEW
from tools.reference_street.sky import environment
from tools.reference_street.textures import make

EXPOSURE = 0.85  # gain of all views, so that most pixels lie in [0, 1]


def encode(linear: Float[np.ndarray, "h w 3"]) -> np.ndarray:
    """Return linear radiance as 8-bit sRGB."""
    x = np.clip(linear, 0, 1)
    srgb = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-8) ** (1 / 2.4) - 0.055)
    return np.round(255 * srgb).astype(np.uint8)


def write_ply(mesh: Mesh, path: Path) -> None:
    """Write a binary PLY with texture coordinates, and with vertex normals if smooth."""
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
    """Return area-weighted vertex normals; coincident vertices (seams, poles) share one."""
    corners = mesh.vertices[mesh.faces]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    _, group = np.unique(np.round(mesh.vertices, 5), axis=0, return_inverse=True)
    group = group.reshape(-1)
    total = np.zeros((group.max() + 1, 3))
    for k in range(3):
        np.add.at(total, group[mesh.faces[:, k]], face)
    normals = total[group]
    # A vertex with degenerate triangles only has no normal: use up.
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.where(length > 1e-12, normals / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])


def load(
    meshes: list[Mesh],
    folder: Path,
    threads: int = 1,
    water: dict | None = None,
    named: bool = False,
    sky: Float[np.ndarray, "h w 3"] | dict | None = None,
    variant: str = "scalar_rgb",
):
    """Return a Mitsuba scene of diffuse, textured meshes under the sky.

    Args:
        meshes: the meshes.
        folder: folder for PLY files; they are read before the function returns.
        threads: number of rendering threads.
        water: Mitsuba's description of a water surface with or without a medium, if any.
        named: keep every mesh as a shape with its name; otherwise meshes of a texture are merged.
        sky: radiance of the sky, or Mitsuba's description of it; default the cloudy one by day.
        variant: of Mitsuba; it stays set.
    """
    import drjit as dr
    import mitsuba as mi

    mi.set_variant(variant)
    dr.set_thread_count(threads)
    scene = {"type": "scene", "integrator": {"type": "path", "max_depth": 5}}
    if water is not None:
        # Paths through the surface to the bottom and back need at least three more bounces.
        scene["integrator"] = {"type": "volpath", "max_depth": 12, "rr_depth": 8}
        scene["water"] = water
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
    if isinstance(sky, dict):
        scene["sky"] = sky
    else:
        rotate = mi.ScalarTransform4f().rotate([1, 0, 0], 90)  # y up to z up
        bitmap = mi.Bitmap((environment() if sky is None else sky).astype(np.float32))
        scene["sky"] = {"type": "envmap", "bitmap": bitmap, "to_world": rotate}
    return mi.load_dict(scene, optimize=not named)


def render_view(
    scene,
    pose: Float[np.ndarray, "4 4"],
    width: int,
    height: int,
    spp: int,
    seed: int,
    integrator=None,
    air=None,
):
    """Return the linear radiance before exposure and the coverage of one view, [h, w, 4].

    `air` is the medium around the camera, if any.
    """
    import mitsuba as mi

    # Mitsuba's camera looks along +z, with +x to the left and +y up.
    to_world = mi.ScalarTransform4f((pose @ np.diag([-1.0, -1.0, 1.0, 1.0])).tolist())
    sensor = {
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
    if air is not None:
        sensor["medium"] = air
    sensor = mi.load_dict(sensor)
    return np.array(mi.render(scene, integrator=integrator, sensor=sensor, spp=spp, seed=seed))

"""Teachers: what the matter on a view's rays should look like.

The operator of seasons and style photos teaches its own colours, the same from all views. Editors
of pictures (WCT, a folder of finished pictures, the user's network) teach a low-frequency gain.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from climatenerf.core.classes import SKY, SOLID
from climatenerf.core.colour import encode_srgb
from climatenerf.core.device import to_device, to_numpy
from climatenerf.core.errors import UserError
from climatenerf.core.srgb import to_display, to_linear
from climatenerf.field.capabilities import CLASSES
from climatenerf.field.compositing import chunks, composited
from climatenerf.field.hash_field import Field
from climatenerf.field.protocol import device_of
from climatenerf.ops.recolouring import mottle
from climatenerf.render.heads import see_surface
from climatenerf.render.volume import camera_rays
from climatenerf.scene.file_names import FileNames
from climatenerf.scene.image_files import PHOTO_SUFFIXES
from climatenerf.scene.images import read_rgb
from climatenerf.styling.paper import wct
from climatenerf.styling.paper.gain import low_frequency_gain
from climatenerf.styling.paper.shots import Shot
from climatenerf.styling.style_photos import LabelledPhoto
from climatenerf.weather.season.entity import no_classes, styled_field
from climatenerf.weather.style import Style

MAX_ASPECT_ERROR = 0.02  # of a picture's sides against the photo's

Teach = Callable[[Shot, Float[Tensor, "n 3"]], Float[Tensor, "n 3"]]
"""Maps a view, and the linear radiance of the matter at its pixels, to the radiance to learn."""
Edit = Callable[[Shot, Float[np.ndarray, "h w 3"]], Float[np.ndarray, "h w 3"]]
"""Maps the clean display picture of a view to a stylised one of the same size, both in [0, 1]."""


@dataclass(frozen=True)
class Teacher:
    """What teaches a field.

    Attributes:
        kind: "operator", "wct", "pictures" or "editor".
        made_from: hash or text that differs between teachers of one kind.
        teach: returns the radiance to learn.
    """

    kind: str
    made_from: str
    teach: Teach


def operator_teacher(field: Field, style: Style) -> Teacher:
    """Return the colour operator of a style as a teacher.

    Raises:
        UserError: the field has no classes.
    """
    if CLASSES not in field.capabilities:
        raise no_classes("a season as teacher")
    device = device_of(field)
    noise = mottle(style.seed).to(device)
    styled = styled_field(field, style, noise, torch.ones(3, device=device))

    def teach(shot: Shot, clean: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        rays_o, rays_d = shot.rays(device)
        parts = []
        for chunk in chunks(rays_o):
            o, d = rays_o[chunk], rays_d[chunk]
            near = torch.full_like(o[:, 0], field.near)
            parts.append(composited(styled, o, d, near)[0])
        return torch.cat(parts)

    return Teacher("operator", style.name, teach)


def picture_teacher(
    field: Field, kind: str, made_from: str, edit: Edit, strength: float = 1.0
) -> Teacher:
    """Return an editor of pictures as a teacher; it sees the field at the mean appearance.

    Args:
        field: the field that is taught.
        kind: of the teacher.
        made_from: hash or text that differs between teachers of one kind.
        edit: the editor.
        strength: fraction of the change that is taught, 0 to 1.
    """

    def teach(shot: Shot, clean: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        size = shot.camera.height, shot.camera.width
        rays_o, rays_d = camera_rays(shot.camera, shot.c2w, device_of(field))
        pixels, opacity = [], []
        for chunk in chunks(rays_o):
            o, d = rays_o[chunk], rays_d[chunk]
            near = torch.full_like(o[:, 0], field.near)
            radiance, transmittance, _ = composited(field, o, d, near)
            pixels.append(radiance + transmittance[:, None] * field.sky(d))
            opacity.append(1 - transmittance)
        picture = to_numpy(encode_srgb(torch.cat(pixels)).clamp(0, 1)).reshape(*size, 3)
        edited = edit(shot, picture)
        gain = low_frequency_gain(
            to_linear(picture), to_linear(edited), to_numpy(torch.cat(opacity)).reshape(size)
        )
        chosen = (1 + strength * (gain - 1)).reshape(-1, 3)[shot.pixels].astype(np.float32)
        return clean * to_device(chosen, clean.device)

    return Teacher(kind, f"{made_from}, strength {strength}", teach)


def wct_editor(field: Field, folder: Path, photos: Sequence[LabelledPhoto], width: int) -> Edit:
    """Return the transfer of style photos by the WCT networks of a folder, class by class.

    Args:
        field: whose classes are transferred.
        folder: of the weights.
        photos: the style photos.
        width: to which wider style photos are reduced, pixels.

    Raises:
        UserError: the weights cannot be used, or the field has no classes.
    """
    if CLASSES not in field.capabilities:
        raise no_classes("a transfer class by class")
    nets = wct.load_autoencoders(folder)
    style = wct.style_moments([_reduced(photo, width) for photo in photos], nets)

    def edit(shot: Shot, picture: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
        return wct.stylised(picture, class_masks(field, shot), style, nets)

    return edit


def class_masks(field: Field, shot: Shot) -> dict[int, np.ndarray]:
    """Return where a view shows each class, found at half its size."""
    camera = shot.camera
    half = camera.resized(max(1, camera.width // 2), max(1, camera.height // 2))
    _, label = see_surface(field, *camera_rays(half, shot.c2w, device_of(field)))
    labels = Image.fromarray(to_numpy(label).reshape(half.height, half.width))
    labels = np.asarray(labels.resize((camera.width, camera.height), Image.Resampling.NEAREST))
    return {int(kind): labels == kind for kind in (*SOLID, SKY)}


def _reduced(photo: LabelledPhoto, width: int) -> tuple[np.ndarray, Mapping[int, np.ndarray]]:
    """Return a style photo as display picture, at most `width` wide, and its masks."""
    picture = to_display(photo.linear)
    factor = -(-picture.shape[1] // width)
    size = -(-picture.shape[1] // factor), -(-picture.shape[0] // factor)
    small = Image.fromarray((picture * 255 + 0.5).astype(np.uint8)).reduce(factor)
    masks = {
        kind: np.asarray(Image.fromarray(mask).resize(size, Image.Resampling.NEAREST))
        for kind, mask in photo.masks.items()
    }
    return np.asarray(small) / 255, masks


def folder_editor(folder: Path, shots: Sequence[Shot]) -> tuple[Edit, tuple[Path, ...]]:
    """Return a folder of finished pictures as an editor, and the pictures it takes.

    A picture has the name of its photo, with any suffix, and the photo's proportions.

    Args:
        folder: the pictures.
        shots: the views that teach.

    Raises:
        UserError: the folder, or a view's picture, is missing.
    """
    if not folder.is_dir():
        raise UserError(f"there is no folder {folder}; give with --pictures a folder of pictures")
    names = FileNames(folder)
    paths = {}
    for shot in shots:
        stem = shot.name.rpartition(".")[0] or shot.name
        suffixes = sorted(PHOTO_SUFFIXES)
        path = names.find_any([shot.name, *(stem + suffix for suffix in suffixes)])
        if path is None:
            raise UserError(
                f"{folder} holds no picture of {shot.name}; each of the {len(shots)} views that"
                " teach needs one of its name, or give fewer with --views"
            )
        paths[shot.name] = path

    def edit(shot: Shot, picture: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
        return fitting(read_rgb(paths[shot.name]), shot, str(paths[shot.name]))

    return edit, tuple(paths[shot.name] for shot in shots)


def fitting(picture: np.ndarray, shot: Shot, name: str) -> Float[np.ndarray, "h w 3"]:
    """Return an 8-bit picture at the size of a view, in [0, 1].

    Raises:
        UserError: it has other proportions.
    """
    height, width = picture.shape[:2]
    camera = shot.camera
    stretch = (width / height) / (camera.width / camera.height)
    # A pixel more or less, from rounding at small sizes, is no other picture.
    slack = MAX_ASPECT_ERROR + 1 / min(camera.width, camera.height)
    if not 1 / (1 + slack) < stretch < 1 + slack:
        raise UserError(
            f"the picture {name} of {width}x{height} pixels has other proportions than its photo"
            f" {shot.name}; make it at the photo's size"
        )
    size = (camera.width, camera.height)
    if (width, height) != size:
        picture = np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX))
    return picture / 255

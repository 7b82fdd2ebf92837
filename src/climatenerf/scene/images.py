"""Reading pictures, labels and masks."""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.core.srgb import to_linear
from climatenerf.scene.label_spaces import to_train_ids
from climatenerf.scene.scene import Scene, View

RELATIVE_DEPTH = "depth_relative"
_ORIENTATION_TAG = 0x0112
EXIF_TRANSPOSES = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
_ON_EDGE = (5, 6, 7, 8)  # tags that exchange width and height
# Where the shown picture's top is in stored pixels, (x, y) with y down, by EXIF orientation.
_SHOWN_UP = {3: (0, 1), 4: (0, 1), 5: (-1, 0), 6: (-1, 0), 7: (1, 0), 8: (1, 0)}
_ALPHA_MODES = ("RGBA", "LA", "PA", "La", "RGBa")
_BAD_IMAGE = (OSError, ValueError, SyntaxError, Image.DecompressionBombError)
_BAD_ARRAY = (OSError, ValueError, EOFError, IndexError, zipfile.BadZipFile, zlib.error)


_LINEAR = to_linear(np.arange(256) / 255).astype(np.float32)
_LINEAR_EDGES = to_linear((np.arange(255) + 0.5) / 255).astype(np.float32)


@dataclass(frozen=True)
class Header:
    """What a picture's header says.

    Attributes:
        width: Stored width, pixels.
        height: Stored height, pixels.
        alpha: Whether it has an alpha channel or a transparent colour.
        orientation: EXIF orientation, 1 to 8; 1 if there is none.
    """

    width: int
    height: int
    alpha: bool
    orientation: int

    def rotates_to_fit(self, camera: Camera) -> bool:
        """Whether loading turns the picture by 90 degrees to fit the camera.

        Poses refer to the stored pixels unless only the turned picture has the camera's size, so
        the EXIF orientation is honoured in that one case.
        """
        stored, wanted = (self.width, self.height), (camera.width, camera.height)
        return stored != wanted and stored[::-1] == wanted and self.orientation in _ON_EDGE

    def up_in_picture(self, camera: Camera) -> tuple[int, int]:
        """(x, y), y down: where the top of the picture as shown is, seen in the loaded pixels."""
        return (0, -1) if self.rotates_to_fit(camera) else _SHOWN_UP.get(self.orientation, (0, -1))


def picture_header(path: Path) -> Header:
    """Read a picture's header, not its pixels.

    Raises:
        UserError: The file is missing or not a picture that Pillow can read.
    """
    try:
        with Image.open(path) as image:
            return _header(image)
    except _BAD_IMAGE as error:
        raise _unreadable(path, error) from None


def _header(image: Image.Image) -> Header:
    orientation = image.getexif().get(_ORIENTATION_TAG, 1)
    return Header(
        *image.size,
        alpha=image.mode in _ALPHA_MODES or "transparency" in image.info,
        orientation=orientation if isinstance(orientation, int) else 1,
    )


def load_image(view: View, scene: Scene, downscale: int = 1) -> UInt8[np.ndarray, "h w 3"]:
    """A view's picture as 8-bit sRGB, area-averaged over `downscale` x `downscale` pixels.

    The average is of linear light. Alpha is dropped (use a mask for what is to be ignored), grey
    becomes RGB and 16-bit pictures are brought to 8 bits. EXIF orientation is ignored unless only
    the turned picture has the camera's size. The result matches `downscaled_camera(camera,
    downscale)`.

    Raises:
        UserError: The picture is missing, truncated, or has another size than its camera.
    """
    camera = scene.cameras[view.camera]
    values = to_rgb(_decode(view.path, camera))
    if downscale == 1:
        return values
    # A larger pixel gathers light, so the mean is taken of linear values.
    linear = _area_average(_LINEAR[values], downscale)
    return np.searchsorted(_LINEAR_EDGES, linear).astype(np.uint8)


def load_labels(view: View, scene: Scene, downscale: int = 1) -> UInt8[np.ndarray, "h w"] | None:
    """Cityscapes train ids (255 unknown) of a view, nearest neighbours; None if absent.

    Whatever the scene's label space is, what comes out are train ids.

    Raises:
        UserError: The file cannot be read, has another shape than the picture, or an id that the
            scene's label space does not have.
    """
    path = view.label_path
    if path is None:
        return None
    labels = to_train_ids(read_labels(path), scene.label_space, path)
    return _nearest(_fitting(labels, scene.cameras[view.camera], path), downscale)


def load_mask(view: View, scene: Scene, downscale: int = 1) -> Bool[np.ndarray, "h w"] | None:
    """True where a view's pixels may be used (mask not black); None if it has no mask.

    A downscaled pixel may be used only if all pixels that it averages may be.
    """
    if view.mask_path is None:
        return None
    usable = _fitting(read_mask(view.mask_path), scene.cameras[view.camera], view.mask_path)
    if downscale == 1:
        return usable
    return _area_average(usable[..., None].astype(np.float32), downscale)[..., 0] > 0.999


def load_depth(view: View, scene: Scene, downscale: int = 1) -> Float[np.ndarray, "h w"] | None:
    """Z-depths of a view in the file's own unit, NaN where unknown; None if it has none."""
    if view.depth_path is None:
        return None
    camera = scene.cameras[view.camera]
    return _nearest(_fitting(read_depth(view.depth_path), camera, view.depth_path), downscale)


def load_relative_depth(
    view: View, scene: Scene, downscale: int = 1
) -> Float[np.ndarray, "h w"] | None:
    """Inverse z-depth of a view up to a scale and a shift of its own; None if it has none.

    From `depth_relative/NAME.npz` or `NAME.jpg.npz` (one array, larger is nearer, any size), else
    from its depth file. NaN where unknown.
    """
    name = scene.root / RELATIVE_DEPTH / view.name
    # The longer name first: beside it, the shorter one may belong to `NAME.png`.
    places = (name.with_name(f"{name.name}.npz"), name.with_suffix(".npz"))
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        depth = load_depth(view, scene, downscale)
        return None if depth is None else 1.0 / depth
    try:
        values = _array_of(path)
        if not np.issubdtype(values.dtype, np.number) or np.iscomplexobj(values):
            raise ValueError("it must hold real numbers")
        if values.ndim != 2 or not values.size:
            raise ValueError("it must have height x width numbers")
        relative = Image.fromarray(values.astype(np.float32))
    except _BAD_ARRAY as error:
        raise _no_array("relative depth", path, error) from None
    full = scene.cameras[view.camera]
    _check_shape(values, full, path)
    camera = downscaled_camera(full, downscale)
    size = (camera.width, camera.height)
    return np.asarray(relative.resize(size, Image.Resampling.BILINEAR))


def read_rgb(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """A picture as it is stored, 8-bit RGB.

    Raises:
        UserError: The file cannot be read.
    """
    return to_rgb(_opened(path))


def read_labels(path: Path) -> UInt8[np.ndarray, "h w"]:
    """An 8-bit picture of class ids.

    Raises:
        UserError: The file cannot be read or is of another kind.
    """
    labels = np.asarray(_opened(path))
    if labels.ndim != 2 or labels.dtype != np.uint8:
        raise UserError(f"The labels {path} are not an 8-bit grey picture of class ids.")
    return labels


def read_mask(path: Path) -> Bool[np.ndarray, "h w"]:
    """A picture as True where it is not black.

    Raises:
        UserError: The file cannot be read.
    """
    opened = _opened(path)
    # A palette's numbers say nothing of black and white, nor does alpha.
    plain = {"P": "RGB", "PA": "RGB", "LA": "L"}.get(opened.mode)
    mask = np.asarray(opened.convert(plain) if plain else opened)
    return (mask if mask.ndim == 2 else mask[..., :3].max(axis=-1)) > 0


def read_depth(path: Path) -> Float[np.ndarray, "h w"]:
    """Z-depths: `.npy`, `.npz` (one array) in metres, or a 16-bit PNG in millimetres (0 unknown).

    Returns:
        float32; NaN where not finite or not above 0.

    Raises:
        UserError: The file cannot be read or holds no such picture.
    """
    try:
        if path.suffix in (".npy", ".npz"):
            depth = _array_of(path)
        else:
            depth = np.asarray(_opened(path)) / 1000
            if depth.ndim == 2 and _opened(path).mode == "L":
                raise UserError(
                    f"The depth {path} has 8 bits; give 16-bit PNG (millimetres), NPY or NPZ (m)."
                )
    except _BAD_ARRAY as error:
        raise _no_array("depth", path, error) from None
    if depth.ndim == 3 and 1 in (depth.shape[0], depth.shape[-1]):
        depth = depth[0] if depth.shape[0] == 1 else depth[..., 0]
    if depth.ndim != 2 or not np.issubdtype(depth.dtype, np.number) or not depth.size:
        raise UserError(f"The depth {path} is no picture of numbers; it must have height x width.")
    depth = depth.astype(np.float32)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan))


def _array_of(path: Path) -> np.ndarray:
    """The numbers of an NPY, or of the first array of an NPZ."""
    data = np.load(path)
    packed = isinstance(data, np.lib.npyio.NpzFile)
    if packed != (path.suffix == ".npz"):
        raise ValueError(f"it is no {path.suffix[1:].upper()}")
    if not packed:
        return data
    with data:
        return data[data.files[0]]


def _no_array(kind: str, path: Path, error: Exception) -> UserError:
    # Numbers are never stored as Python objects, and those are not to be trusted.
    reason = "it holds no numbers" if "pickle" in str(error) else error
    return UserError(f"The {kind} {path} cannot be read ({reason}); replace it.")


def downscaled_camera(camera: Camera, downscale: int) -> Camera:
    """The camera of a picture downscaled by a whole number; odd rows and columns are cut off."""
    if downscale < 1 or downscale > min(camera.width, camera.height):
        raise UserError(
            f"Pictures of {camera.width}x{camera.height} pixels cannot be downscaled by "
            f"{downscale}; choose a number from 1 to {min(camera.width, camera.height)}."
        )
    width, height = camera.width // downscale, camera.height // downscale
    cut = Camera(**{**camera.__dict__, "width": width * downscale, "height": height * downscale})
    return cut.resized(width, height)


def _unreadable(path: Path, error: Exception) -> UserError:
    if isinstance(error, FileNotFoundError):
        return UserError(f"The picture {path} is missing; restore it or remove its pose.")
    return UserError(
        f"The picture {path} cannot be read (truncated, damaged or of an unknown kind); replace "
        "it or remove it."
    )


def _decode(path: Path, camera: Camera) -> Image.Image:
    """The whole picture in memory, turned by EXIF only if that gives the camera's size."""
    try:
        with Image.open(path) as image:
            image.load()
            header = _header(image)
            if header.rotates_to_fit(camera):
                return image.transpose(EXIF_TRANSPOSES[header.orientation])
            decoded = image.copy()
    except _BAD_IMAGE as error:
        raise _unreadable(path, error) from None
    wanted = (camera.width, camera.height)
    if decoded.size != wanted:
        raise UserError(
            f"The picture {path} has {decoded.width}x{decoded.height} pixels but its camera "
            f"{camera.width}x{camera.height}; make them agree."
        )
    return decoded


def _opened(path: Path) -> Image.Image:
    """A whole picture in memory, as it is stored."""
    try:
        with Image.open(path) as image:
            image.load()
            return image.copy()
    except _BAD_IMAGE as error:
        raise _unreadable(path, error) from None


def _fitting(values: np.ndarray, camera: Camera, path: Path) -> np.ndarray:
    """Values at the camera's pixels: the nearest ones of a file of another size, same shape.

    Labels, masks and depths may have been made from larger or smaller pictures.
    """
    height, width = values.shape
    _check_shape(values, camera, path)
    rows = (np.arange(camera.height) + 0.5) * height / camera.height
    columns = (np.arange(camera.width) + 0.5) * width / camera.width
    return values[rows.astype(np.int64)[:, None], columns.astype(np.int64)]


def _check_shape(values: np.ndarray, camera: Camera, path: Path) -> None:
    height, width = values.shape
    if abs(width * camera.height / (height * camera.width) - 1) >= 0.02:
        raise UserError(
            f"The picture {path} has {width}x{height} pixels but its camera "
            f"{camera.width}x{camera.height}; make them agree."
        )


def to_rgb(image: Image.Image) -> UInt8[np.ndarray, "h w 3"]:
    """8-bit RGB values of a picture of any kind, without its alpha channel."""
    if image.mode in _ALPHA_MODES or "transparency" in image.info:
        # Going through RGBA, Pillow's conversion to RGB keeps the stored colours as they are.
        image = image.convert("RGBA")
    if image.mode.startswith("I") or image.mode == "F":
        values = np.asarray(image, dtype=np.float64)
        top = 255.0 if values.max(initial=0.0) <= 255 and image.mode != "I;16" else 65535.0
        grey = np.rint(np.clip(values / top, 0, 1) * 255).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=-1)
    return np.array(image.convert("RGB"))


def _cut(values: np.ndarray, downscale: int) -> np.ndarray:
    height, width = values.shape[0] // downscale, values.shape[1] // downscale
    if downscale < 1 or not height or not width:
        raise UserError(f"A picture cannot be downscaled by {downscale}; choose a smaller number.")
    return values[: height * downscale, : width * downscale]


def _area_average(
    values: Float[np.ndarray, "h w c"], downscale: int
) -> Float[np.ndarray, "hs ws c"]:
    cut = _cut(values, downscale)
    h, w, c = cut.shape
    return cut.reshape(h // downscale, downscale, w // downscale, downscale, c).mean(axis=(1, 3))


def _nearest(values: UInt8[np.ndarray, "h w"], downscale: int) -> UInt8[np.ndarray, "hs ws"]:
    half = downscale // 2
    return np.ascontiguousarray(_cut(values, downscale)[half::downscale, half::downscale])

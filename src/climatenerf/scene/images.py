"""Reading images, labels, masks and depth files of a scene."""

from __future__ import annotations

import errno
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import ExifTags, Image

from climatenerf.core import arrays
from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError, explain, one_line
from climatenerf.core.srgb import to_linear
from climatenerf.scene.image_files import (
    differs_from_srgb,
    hdr_of,
    hdr_to_srgb,
    open_image,
    profile_to_srgb,
)
from climatenerf.scene.label_spaces import to_train_ids
from climatenerf.scene.scene import MILLIMETRES, Scene, View, is_file

RELATIVE_DEPTH = "depth_relative"
SATURATED = 65535  # of 16-bit depth files
MAX_FLOAT_DEPTH = 1e5  # m; bytes of colours give larger numbers, or none
_ORIENTATION_TAG, _EXIF_TAG, _FOCAL_35MM_TAG = 0x0112, 0x8769, 0xA405
# Pillow operation that displays a stored image upright, by EXIF orientation.
EXIF_TRANSPOSES = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
_SWAPS_SIDES = (5, 6, 7, 8)  # orientations that exchange width and height
# Direction of the displayed image's top in stored pixels, (x, y) with y down, by EXIF orientation.
_DISPLAYED_UP = {3: (0, 1), 4: (0, 1), 5: (-1, 0), 6: (-1, 0), 7: (1, 0), 8: (1, 0)}
ALPHA_MODES = ("RGBA", "LA", "PA", "La", "RGBa")
_IMAGE_ERRORS = (
    OSError,
    ValueError,
    SyntaxError,
    EOFError,
    RuntimeError,  # of the HEIC decoder
    Image.DecompressionBombError,
)

# Linear light of each 8-bit value, and the midpoints between consecutive values for re-encoding.
_LINEAR = to_linear(np.arange(256) / 255).astype(np.float32)
_LINEAR_EDGES = to_linear((np.arange(255) + 0.5) / 255).astype(np.float32)
_STRIP = 1 << 20  # pixels of an image that are converted at once


@dataclass(frozen=True)
class Header:
    """Header of an image file.

    Attributes:
        width: Stored width, pixels.
        height: Stored height, pixels.
        alpha: Whether the image has an alpha channel or a transparent colour.
        orientation: EXIF orientation, 1 to 8; 1 if absent, and for HEIC, which is decoded upright.
        hdr: Whether the image has an HDR signal (HLG or PQ), which loading tone-maps.
    """

    width: int
    height: int
    alpha: bool
    orientation: int
    hdr: bool = False

    def rotates_to_fit(self, camera: Camera) -> bool:
        """Return whether loading rotates the image by 90 degrees to match the camera's size.

        Poses refer to the stored pixels, so EXIF orientation is normally ignored. The exception is
        an image whose stored size differs from the camera's and whose rotated size equals it.
        """
        stored, expected = (self.width, self.height), (camera.width, camera.height)
        return stored != expected and stored[::-1] == expected and self.orientation in _SWAPS_SIDES

    def up_direction(self, camera: Camera) -> tuple[int, int]:
        """Return the displayed image's up direction in loaded pixels, (x, y) with y down."""
        return (
            (0, -1) if self.rotates_to_fit(camera) else _DISPLAYED_UP.get(self.orientation, (0, -1))
        )


def read_header(path: Path) -> Header:
    """Read an image's header without decoding its pixels.

    Raises:
        UserError: The file is missing or is not an image that Pillow can read.
    """
    try:
        with open_image(path) as image:
            return _header(image)
    except _IMAGE_ERRORS as error:
        raise _image_error(path, error) from None


def focal_35mm(path: Path) -> float | None:
    """Return EXIF's FocalLengthIn35mmFilm, mm; None if absent or the image is unreadable."""
    try:
        with open_image(path) as image:
            value = _exif(image).get_ifd(_EXIF_TAG).get(_FOCAL_35MM_TAG)
            number = float(value) if value else 0.0
    except (*_IMAGE_ERRORS, TypeError, ZeroDivisionError, UserError):
        return None
    return number if 0 < number < 1e4 else None


def read_exif_of(path: Path) -> Image.Exif | None:
    """Return a photo's EXIF; None if the photo is unreadable."""
    try:
        with open_image(path) as image:
            exif = _exif(image)
            for part in (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo):
                exif.get_ifd(part)  # read while the file is open
            return exif
    except (*_IMAGE_ERRORS, TypeError, ZeroDivisionError, UserError):
        return None


def _exif(image: Image.Image) -> Image.Exif:
    """Return the EXIF of an opened image, without decoding its pixels."""
    # Of a PNG without EXIF, Pillow decodes all pixels to look for EXIF behind them.
    return Image.Image.getexif(image) if image.format == "PNG" else image.getexif()


def _header(image: Image.Image) -> Header:
    orientation = _exif(image).get(_ORIENTATION_TAG, 1)
    return Header(
        *image.size,
        alpha=image.mode in ALPHA_MODES or "transparency" in image.info,
        orientation=orientation if isinstance(orientation, int) else 1,
        hdr=hdr_of(image) is not None,
    )


def load_image(view: View, scene: Scene, downscale: int = 1) -> UInt8[np.ndarray, "h w 3"]:
    """Load a view's image as 8-bit sRGB, averaged over `downscale` x `downscale` pixels.

    The average is taken in linear light. Alpha is dropped (use a mask to exclude pixels), grey
    becomes RGB and 16-bit images are reduced to 8 bits. HDR (HLG, PQ) is tone-mapped, and colour
    profiles that differ from sRGB are converted. EXIF orientation is ignored unless only the
    rotated image has the camera's size. The result matches `downscaled_camera(camera, downscale)`.

    Raises:
        UserError: The image is missing or truncated, or its size differs from its camera's.
    """
    camera = scene.cameras[view.camera]
    values = to_rgb(_read_posed_image(view.path, camera))
    if downscale == 1:
        return values
    # A larger pixel integrates light, so the average is over linear values.
    values = _crop(values, downscale)
    out = np.empty((values.shape[0] // downscale, values.shape[1] // downscale, 3), np.uint8)
    rows = max(1, _STRIP // (values.shape[1] * downscale))  # at once: floats take 12 bytes a pixel
    for start in range(0, len(out), rows):
        strip = values[start * downscale : (start + rows) * downscale]
        linear = _area_average(_LINEAR[strip], downscale)
        out[start : start + rows] = np.searchsorted(_LINEAR_EDGES, linear)
    return out


def load_grey(view: View, scene: Scene, side: int) -> UInt8[np.ndarray, "h w"]:
    """Load a view's image as 8-bit grey, reduced to at most `side` pixels along the longer side.

    JPEG files are decoded at a reduced size, which is several times faster. Sizes are those of
    `camera.resized(...)` with both sides rounded.

    Raises:
        UserError: The image cannot be read, or its size differs from its camera's.
    """
    camera = scene.cameras[view.camera]
    factor = min(1.0, side / max(camera.width, camera.height))
    size = round(camera.width * factor), round(camera.height * factor)
    try:
        with open_image(view.path) as image:
            header = _header(image)
            rotated = header.rotates_to_fit(camera)
            if not rotated and image.size != (camera.width, camera.height):
                raise _size_error(view.path, *image.size, camera)
            image.draft("L", (size[1], size[0]) if rotated else size)
            grey = image.convert("L")
    except _IMAGE_ERRORS as error:
        raise _image_error(view.path, error) from None
    if rotated:
        grey = grey.transpose(EXIF_TRANSPOSES[header.orientation])
    return np.asarray(grey.resize(size, Image.Resampling.BOX))


def load_labels(view: View, scene: Scene, downscale: int = 1) -> UInt8[np.ndarray, "h w"] | None:
    """Load a view's labels as Cityscapes train ids, 255 unknown; None if it has none.

    Ids are converted from the scene's label space. Resampling takes the nearest pixel.

    Raises:
        UserError: The file cannot be read, its aspect ratio differs from the camera's, or an id is
            undefined in the scene's label space.
    """
    path = view.label_path
    if path is None:
        return None
    labels = to_train_ids(read_labels(path), scene.label_space, path)
    return _decimate(_resize_nearest(labels, scene.cameras[view.camera], path), downscale)


def load_mask(view: View, scene: Scene, downscale: int = 1) -> Bool[np.ndarray, "h w"] | None:
    """Load a view's mask, True where pixels may be used (not black); None if it has none.

    A downscaled pixel is True only if all pixels that it averages are.

    Raises:
        UserError: The file cannot be read or its aspect ratio differs from the camera's.
    """
    if view.mask_path is None:
        return None
    usable = _resize_nearest(read_mask(view.mask_path), scene.cameras[view.camera], view.mask_path)
    if downscale == 1:
        return usable
    # 0.999: the float32 mean of ones may round below 1.
    return _area_average(usable[..., None].astype(np.float32), downscale)[..., 0] > 0.999


def load_depth(view: View, scene: Scene, downscale: int = 1) -> Float[np.ndarray, "h w"] | None:
    """Load a view's z-depths in the unit of the file, NaN where unknown; None if it has none.

    Raises:
        UserError: The file cannot be read or its aspect ratio differs from the camera's.
    """
    if view.depth_path is None:
        return None
    depth = read_depth(view.depth_path, scene.depth_scale)
    return _decimate(_resize_nearest(depth, scene.cameras[view.camera], view.depth_path), downscale)


def load_relative_depth(
    view: View, scene: Scene, downscale: int = 1
) -> Float[np.ndarray, "h w"] | None:
    """Load a view's inverse z-depth up to an unknown scale and shift; None if it has none.

    The source is `depth_relative/NAME.npz` or `NAME.jpg.npz` (one array of any size, larger is
    nearer), otherwise the reciprocal of the view's depth file. NaN where unknown.

    Raises:
        UserError: The file cannot be read or its aspect ratio differs from the camera's.
    """
    name = scene.root / RELATIVE_DEPTH / view.name
    # The longer name first: `NAME.npz` may belong to `NAME.png` if `NAME.jpg.npz` exists.
    candidates = (name.with_name(f"{name.name}.npz"), name.with_suffix(".npz"))
    path = next((candidate for candidate in candidates if is_file(candidate)), None)
    if path is None:
        depth = load_depth(view, scene, downscale)
        return None if depth is None else 1.0 / depth
    try:
        values = _read_array(path)
        if not np.issubdtype(values.dtype, np.number) or np.iscomplexobj(values):
            raise ValueError("it must hold real numbers")
        if values.ndim != 2 or not values.size:
            raise ValueError("it must have shape height x width")
        relative = Image.fromarray(values.astype(np.float32))
    except arrays.ERRORS as error:
        raise _array_error("relative depth", path, error) from None
    full = scene.cameras[view.camera]
    _check_aspect(values, full, path)
    camera = downscaled_camera(full, downscale)
    size = (camera.width, camera.height)
    return np.asarray(relative.resize(size, Image.Resampling.BILINEAR))


def read_rgb(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Read an image as stored, 8-bit RGB.

    Raises:
        UserError: The file cannot be read.
    """
    return to_rgb(_read_image(path))


def read_labels(path: Path) -> UInt8[np.ndarray, "h w"]:
    """Read an 8-bit image of class ids.

    Raises:
        UserError: The file cannot be read or is not an 8-bit grey image.
    """
    labels = np.asarray(_read_image(path))
    if labels.ndim != 2 or labels.dtype != np.uint8:
        raise UserError(
            f"The labels {path} are not an 8-bit grey image of class ids; convert them to one."
        )
    return labels


def read_mask(path: Path) -> Bool[np.ndarray, "h w"]:
    """Read an image as True where it is not black.

    Raises:
        UserError: The file cannot be read.
    """
    image = _read_image(path)
    # Palette indices do not encode brightness, and alpha is ignored.
    mode = {"P": "RGB", "PA": "RGB", "LA": "L"}.get(image.mode)
    mask = np.asarray(image.convert(mode) if mode else image)
    return (mask if mask.ndim == 2 else mask[..., :3].max(axis=-1)) > 0


def read_depth(path: Path, scale: float = MILLIMETRES) -> Float[np.ndarray, "h w"]:
    """Read z-depths: NPY or NPZ (one array) in metres, a 16-bit PNG of integers, or floats as RGBA.

    Args:
        path: The file.
        scale: Metres per unit of a 16-bit PNG. 0 and 65535 are unknown: the second is where
            sensors and programs, this one too, store the sky and what is beyond their range.

    Returns:
        float32; NaN where unknown, not finite or not above 0.

    Raises:
        UserError: The file cannot be read or holds no two-dimensional array of numbers.
    """
    try:
        if path.suffix in (".npy", ".npz"):
            depth = _read_array(path)
        else:
            image = _read_image(path)
            if image.mode == "L":
                raise UserError(
                    f"The depth {path} has 8 bits; use 16-bit PNG (millimetres), NPY or NPZ (m)."
                )
            depth = _float_depth(image) if image.mode == "RGBA" else _integer_depth(image, scale)
    except arrays.ERRORS as error:
        raise _array_error("depth", path, error) from None
    if depth.ndim == 3 and 1 in (depth.shape[0], depth.shape[-1]):
        depth = depth[0] if depth.shape[0] == 1 else depth[..., 0]
    real = np.issubdtype(depth.dtype, np.number) and not np.iscomplexobj(depth)
    if depth.ndim != 2 or not real or not depth.size:
        raise UserError(
            f"The depth {path} is not an array of numbers of shape height x width; replace it."
        )
    depth = depth.astype(np.float32)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan))


def _integer_depth(image: Image.Image, scale: float) -> np.ndarray:
    units = np.asarray(image)
    return np.where(units == SATURATED, np.nan, units / (1 / scale))


def _float_depth(image: Image.Image) -> np.ndarray:
    """Return the depths, m, of a PNG that NeRFCapture wrote: the bytes of floats as RGBA."""
    depth = np.ascontiguousarray(np.asarray(image)).view("<f4")[..., 0]
    if not (np.isfinite(depth) & (depth >= 0) & (depth < MAX_FLOAT_DEPTH)).all():
        raise ValueError("its four channels are no depths in metres")
    return depth


def check_sidecar(path: Path, camera: Camera) -> None:
    """Check by its header that labels, a mask or depths have the shape of their photo.

    Raises:
        UserError: The file cannot be read, or its aspect ratio differs from the camera's.
    """
    if path.suffix in (".npy", ".npz"):
        try:
            shape = arrays.shape_of(path)
        except arrays.ERRORS as error:
            raise _array_error("depth", path, error) from None
        # A leading or trailing axis of length one is dropped; loading refuses other shapes.
        sides = [side for side in shape if side != 1] if len(shape) == 3 else list(shape)
        if len(sides) != 2 or not all(sides):
            return
        height, width = sides
    else:
        header = read_header(path)
        width, height = header.width, header.height
    _check_shape(width, height, camera, path)


def downscaled_camera(camera: Camera, downscale: int) -> Camera:
    """Return the camera of an image downscaled by an integer; surplus rows and columns are cropped.

    Raises:
        UserError: `downscale` is below 1 or above the image's smaller side.
    """
    if downscale < 1 or downscale > min(camera.width, camera.height):
        raise UserError(
            f"Images of {camera.width}x{camera.height} pixels cannot be downscaled by "
            f"{downscale}; choose a number from 1 to {min(camera.width, camera.height)}."
        )
    width, height = camera.width // downscale, camera.height // downscale
    cropped = replace(camera, width=width * downscale, height=height * downscale)
    return cropped.resized(width, height)


def to_rgb(image: Image.Image) -> UInt8[np.ndarray, "h w 3"]:
    """Convert an image of any mode to 8-bit RGB, dropping alpha without compositing."""
    if image.mode in ALPHA_MODES or "transparency" in image.info:
        # Pillow's conversion to RGB via RGBA keeps the stored colours of transparent pixels.
        image = image.convert("RGBA")
    if image.mode.startswith("I") or image.mode == "F":
        return np.repeat(wide_grey_to_8_bits(image)[..., None], 3, axis=-1)
    return np.array(image.convert("RGB"))


def wide_grey_to_8_bits(image: Image.Image) -> UInt8[np.ndarray, "h w"]:
    """Reduce a grey image of more than 8 bits to 8 bits, in strips that bound the memory."""
    grey = np.asarray(image)
    top = 255.0 if image.mode != "I;16" and grey.max(initial=0) <= 255 else 65535.0
    out = np.empty(grey.shape, np.uint8)
    rows = max(1, _STRIP // max(grey.shape[1], 1))
    for start in range(0, len(grey), rows):
        strip = grey[start : start + rows].astype(np.float64)
        out[start : start + rows] = np.rint(np.clip(strip / top, 0, 1) * 255)
    return out


def _read_image(path: Path) -> Image.Image:
    """Read and decode an image as stored."""
    try:
        with open_image(path) as image:
            image.load()
            return image
    except _IMAGE_ERRORS as error:
        raise _image_error(path, error) from None


def _read_posed_image(path: Path, camera: Camera) -> Image.Image:
    """Read an image in sRGB; rotate it by EXIF only if that gives the camera's size."""
    try:
        with open_image(path) as image:
            header, hdr, profile = _header(image), hdr_of(image), image.info.get("icc_profile")
            if hdr is not None:
                decoded = hdr_to_srgb(image, hdr)
            else:
                image.load()
                decoded = image
                if profile and differs_from_srgb(profile):
                    decoded = profile_to_srgb(Image.fromarray(to_rgb(image)), profile)
            # A TIFF decoder rotates the picture itself.
            if header.rotates_to_fit(camera) and decoded.size == (header.width, header.height):
                decoded = decoded.transpose(EXIF_TRANSPOSES[header.orientation])
    except _IMAGE_ERRORS as error:
        raise _image_error(path, error) from None
    if decoded.size != (camera.width, camera.height):
        raise _size_error(path, decoded.width, decoded.height, camera)
    return decoded


def _read_array(path: Path) -> np.ndarray:
    """Read the array of an NPY file, or the first array of an NPZ file."""
    if path.suffix != ".npz":
        return arrays.read_npy(path)
    found = arrays.read_npz(path)
    if not found:
        raise ValueError("it holds no array")
    return next(iter(found.values()))


def _image_error(path: Path, error: Exception) -> UserError:
    if isinstance(error, FileNotFoundError):
        return UserError(f"The image {path} is missing; restore it or remove its pose.")
    if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
        return explain(error, path)  # such as a lack of permission
    return UserError(
        f"The image {path} cannot be read (truncated, damaged or of an unknown format); replace "
        "it or remove it."
    )


def _array_error(kind: str, path: Path, error: Exception) -> UserError:
    # NumPy refuses pickled objects, which could run code; its message is of no use to a user.
    if isinstance(error, OSError) and error.errno is not None:
        return explain(error, path)
    reason = "it holds no numbers" if "pickle" in str(error) else one_line(str(error), 120)
    return UserError(f"The {kind} {path} cannot be read ({reason}); replace it.")


def _size_error(path: Path, width: int, height: int, camera: Camera) -> UserError:
    return UserError(
        f"The image {path} has {width}x{height} pixels but its camera "
        f"{camera.width}x{camera.height}; make the sizes agree."
    )


def _check_aspect(values: np.ndarray, camera: Camera, path: Path) -> None:
    height, width = values.shape
    _check_shape(width, height, camera, path)


def _check_shape(width: int, height: int, camera: Camera, path: Path) -> None:
    # 2 %: a reduced image rounds each side to a whole pixel.
    if abs(width * camera.height / (height * camera.width) - 1) >= 0.02:
        raise _size_error(path, width, height, camera)


def _resize_nearest(values: np.ndarray, camera: Camera, path: Path) -> np.ndarray:
    """Resample to the camera's size by nearest neighbour; the aspect ratio must agree.

    Labels, masks and depths may have been computed from larger or smaller images.
    """
    height, width = values.shape
    _check_aspect(values, camera, path)
    rows = (np.arange(camera.height) + 0.5) * height / camera.height
    columns = (np.arange(camera.width) + 0.5) * width / camera.width
    return values[rows.astype(np.int64)[:, None], columns.astype(np.int64)]


def _crop(values: np.ndarray, downscale: int) -> np.ndarray:
    """Crop height and width to multiples of `downscale`."""
    height, width = values.shape[0] // downscale, values.shape[1] // downscale
    if downscale < 1 or not height or not width:
        raise UserError(f"An image cannot be downscaled by {downscale}; choose a smaller number.")
    return values[: height * downscale, : width * downscale]


def _area_average(
    values: Float[np.ndarray, "h w c"], downscale: int
) -> Float[np.ndarray, "hs ws c"]:
    cropped = _crop(values, downscale)
    h, w, c = cropped.shape
    return cropped.reshape(h // downscale, downscale, w // downscale, downscale, c).mean(
        axis=(1, 3)
    )


def _decimate(values: np.ndarray, downscale: int) -> np.ndarray:
    """Keep the middle pixel of each `downscale` x `downscale` block."""
    half = downscale // 2
    return np.ascontiguousarray(_crop(values, downscale)[half::downscale, half::downscale])

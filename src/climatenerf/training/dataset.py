"""All training pixels as one list of rays with colours and labels."""

import copy
import os
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import GROUND, MERGED, SKY, STANDING, UNKNOWN
from climatenerf.core.device import CPU, integers, to_device, to_numpy, upload
from climatenerf.core.errors import UserError
from climatenerf.training.evidence.frusta import frustum_planes
from climatenerf.training.evidence.visual_hull import VisualHull
from climatenerf.training.pixel_directions import Directions

SPACINGS = (1, 2, 4, 8)  # pixels between the middle and the sides of a triple
HORIZON = -0.05  # sine of the elevation; lower rays end on matter (gravity alignment: 1 to 2 deg)
SKY_CONSENSUS = 0.1  # fraction of the views of a position that must show sky there,
GROUND_CONSENSUS = 0.5  # or ground,
OBSTACLE_CONSENSUS = 0.5  # or obstacles
MAX_DRAWN = 2**22  # pixels drawn at once where masks hide nearly all
MAX_IN_MEMORY = 2_000_000_000  # bytes of all colours, or of all labels; more go to a file
NEARBY = 1  # pixels on each side whose colours explain a pixel's error
EDGE = 2  # pixels on both sides of a border that belong to the sky's edge


@dataclass
class Batch:
    """n rays drawn from the training images.

    With m = len(in_line), the last 2m rays are the two sides of the first m: pixels in a line at
    equal distances.
    """

    rays_o: Float[Tensor, "n 3"]
    """Origins, world m."""
    rays_d: Float[Tensor, "n 3"]
    """Unit directions."""
    image: Int[Tensor, "n"]
    """Index of the training image."""
    rgb: Float[Tensor, "n 3"]
    """Display sRGB in [0,1]."""
    label: UInt8[Tensor, "n"]
    """Merged class of the image's label; 255: unknown."""
    xy: Float[Tensor, "n 2"]
    """Position in the image, (x, y) in (0,1)."""
    cosine: Float[Tensor, "n"]
    """Cosine of the angle between the ray and the optical axis."""
    in_line: Bool[Tensor, "m"]
    """Which triples lie entirely in their image and outside its mask."""
    relative: Float[Tensor, "n"] | None
    """Relative inverse z-depth (see `monocular_depth.py`), NaN where unknown; None without any."""

    @property
    def is_sky(self) -> Float[Tensor, "n"]:
        """1 where the image's label is sky, else 0."""
        return (self.label == SKY).float()


class TrainingPixels:
    """The pixels of all training images, as 8-bit values, from which steps draw."""

    def __init__(
        self,
        cameras: Sequence[Camera],
        camera_of: Sequence[int],
        c2w: Float[np.ndarray, "v 4 4"],
        images: Iterable[UInt8[np.ndarray, "h w 3"]],
        labels: Iterable[UInt8[np.ndarray, "h w"] | None] | None = None,
        masks: Iterable[Shaped[np.ndarray, "h w"] | None] | None = None,
        relative: Iterable[Float[np.ndarray, "h w"] | None] | None = None,
        device: torch.device = CPU,
    ):
        """Read all images.

        Images, labels, masks and depths are taken one at a time, so a generator saves memory.

        Args:
            cameras: in the size of the (already downscaled) images.
            camera_of: index of each image's camera.
            c2w: pose of each image, world m.
            images: display sRGB.
            labels: class ids of each image; None: unlabelled.
            masks: 0 where pixels are never drawn and count as unlabelled; None: all are usable.
            relative: relative inverse z-depth of each image, NaN where unknown; None: unknown.
            device: where the pixels are stored, and a fit to them computes.
        """
        self.c2w = to_device(np.asarray(c2w, np.float32), device)
        self.cameras = [cameras[i] for i in camera_of]
        self.directions = Directions(cameras, device)
        self.camera = torch.tensor(list(camera_of), device=device)
        self.frusta = frustum_planes(self.cameras, c2w, device)
        self.width = torch.tensor([camera.width for camera in self.cameras], device=device)
        self.height = torch.tensor([camera.height for camera in self.cameras], device=device)
        counts = self.width * self.height
        self.pixel_start = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
        shapes = [(camera.height, camera.width) for camera in self.cameras]
        rgb, _ = in_one_row(shapes, images, np.uint8, 0, channels=3)
        self.rgb = to_device(rgb, device)
        self.usable, self.drawable, self.usable_fraction = None, None, 1.0
        self.spacings = torch.tensor(SPACINGS, device=device)
        self.axes = torch.tensor([[1, 0], [0, 1], [1, 1], [1, -1]], device=device)
        usable = (None if mask is None else mask > 0 for mask in masks or ())
        flat, unmasked = in_one_row(shapes, usable, np.bool_, True)
        if flat.size:
            self.usable, self.drawable = to_device(flat, device), torch.from_numpy(flat)
            self.usable_fraction = int(flat.sum()) / flat.size
        self.label = None
        self.sky_hull = None
        self.edge = self.pixel_start[:0]
        classes = (None if label is None else MERGED[label] for label in labels or ())
        flat, merged = in_one_row(shapes, classes, np.uint8, UNKNOWN)
        for image, label in enumerate(merged):
            if unmasked:  # masked pixels are no evidence of empty space, either
                label[~unmasked[image]] = UNKNOWN
            # Networks label puddles and wet walls as the sky that they mirror.
            row, column = np.nonzero(label == SKY)
            camera = self.camera[image].expand(len(row))
            d = self.directions.of(camera, *(to_device(each, device) for each in (column, row)))
            low = to_numpy(d @ self.c2w[image, 2, :3] < HORIZON)
            label[row[low], column[low]] = UNKNOWN
        if (flat != UNKNOWN).any():
            self.label = to_device(flat, device)
        if self.label is not None and bool((self.label == SKY).any()):
            at = [np.flatnonzero(sky_edge(each)) for each in merged]
            starts = to_numpy(self.pixel_start)[:-1]
            edge = np.concatenate([e + s for e, s in zip(at, starts, strict=True)])
            self.edge = to_device(edge, device)
            self.sky_hull = VisualHull(self.cameras, c2w, merged, [SKY], SKY_CONSENSUS, device)
        self.ground_hull = self.obstacle_hull = None
        ground = torch.tensor(GROUND, dtype=torch.uint8, device=device)
        if self.label is not None and bool(torch.isin(self.label, ground).any()):
            of = self.cameras, c2w, merged
            self.ground_hull = VisualHull(*of, GROUND, GROUND_CONSENSUS, device)
            self.obstacle_hull = VisualHull(*of, STANDING, OBSTACLE_CONSENSUS, device)
        scaled = (None if depth is None else in_units(depth) for depth in relative or ())
        flat, _ = in_one_row(shapes, scaled, np.float16, np.nan)
        self.relative = to_device(flat, device) if flat.size else None

    @property
    def device(self) -> torch.device:
        """Where the pixels are stored, and a fit to them computes."""
        return self.c2w.device

    def without_sky(self) -> "TrainingPixels":
        """Return the same pixels, with those labelled sky unlabelled."""
        other = copy.copy(self)
        other.sky_hull, other.edge = None, self.edge[:0]
        if self.label is not None:
            other.label = torch.where(self.label == SKY, UNKNOWN, self.label).to(torch.uint8)
        return other

    def xy_towards(
        self, image: Int[Tensor, "n"], rays_d: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n 2"]:
        """Return the position (x, y), in (0,1), of a direction in each image; NaN outside it."""
        out = rays_d.new_full((image.shape[0], 2), torch.nan)
        for i in to_numpy(image.unique()).tolist():
            rows = (image == i).nonzero()[:, 0]
            camera = self.cameras[i]
            pixel = camera.project(to_numpy(rays_d[rows] @ self.c2w[i, :3, :3]))
            xy = pixel / (camera.width, camera.height)
            with np.errstate(invalid="ignore"):  # behind the camera: NaN
                inside = np.all((xy >= 0) & (xy < 1), axis=-1)
            found = to_device(xy[inside].astype(np.float32), self.device)
            out[rows[to_device(inside, self.device)]] = found
        return out

    def pixel_towards(
        self, image: Int[Tensor, "n"], rays_d: Float[Tensor, "n 3"]
    ) -> tuple[Bool[Tensor, "n"], Int[Tensor, "k"]]:
        """Return which directions lie in their image, and the pixels of those."""
        xy = self.xy_towards(image, rays_d)
        inside = ~xy[:, 0].isnan()
        image, xy = image[inside], xy[inside]
        width, height = self.width[image], self.height[image]
        # Rounding may turn the last pixel's border into 1.
        x = (xy[:, 0] * width).long().minimum(width - 1)
        y = (xy[:, 1] * height).long().minimum(height - 1)
        return inside, self.pixel_start[image] + y * width + x

    def label_towards(
        self, image: Int[Tensor, "n"], rays_d: Float[Tensor, "n 3"]
    ) -> UInt8[Tensor, "n"]:
        """Return the merged class of an image in each direction; unknown outside the image."""
        out = torch.full_like(image, UNKNOWN, dtype=torch.uint8)
        if self.label is not None:
            inside, pixel = self.pixel_towards(image, rays_d)
            out[inside] = self.label[pixel]
        return out

    def usable_towards(
        self, image: Int[Tensor, "n"], rays_d: Float[Tensor, "n 3"]
    ) -> Bool[Tensor, "n"]:
        """Return whether an image's mask leaves the pixel in each direction."""
        out = torch.ones_like(image, dtype=torch.bool)
        if self.usable is not None:
            inside, pixel = self.pixel_towards(image, rays_d)
            out[inside] = self.usable[pixel]
        return out

    def colours_nearby(
        self, image: Int[Tensor, "n"], xy: Float[Tensor, "n 2"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Return minimum and maximum display sRGB, by channel, of pixels up to `NEARBY` away."""
        width, height = self.width[image], self.height[image]
        x, y = (xy[:, 0] * width).long(), (xy[:, 1] * height).long()
        pixels = [
            self.pixel_start[image]
            + (y + down).clamp_min(0).minimum(height - 1) * width
            + (x + right).clamp_min(0).minimum(width - 1)
            for down in range(-NEARBY, NEARBY + 1)
            for right in range(-NEARBY, NEARBY + 1)
        ]
        low, high = torch.aminmax(self.rgb[torch.stack(pixels)], dim=0)
        return low.float() / 255.0, high.float() / 255.0

    @property
    def knows_sky(self) -> bool:
        """Whether any pixel is labelled sky."""
        return self.label is not None and bool((self.label == SKY).any())

    def classes(self) -> UInt8[Tensor, "k"]:
        """Return the merged classes that occur, unknown included; empty without labels."""
        if self.label is None:
            return torch.zeros(0, dtype=torch.uint8, device=self.device)
        # In pieces: to sort all labels would take twenty times their memory.
        pieces = [
            torch.bincount(each.long(), minlength=256) for each in self.label.split(MAX_DRAWN)
        ]
        return torch.stack(pieces).sum(0).nonzero()[:, 0].to(torch.uint8)

    def draw(
        self, n: int, generator: torch.Generator, triples: int = 0, edges: float = 0.0
    ) -> Batch:
        """Draw random pixels.

        Args:
            n: number of pixels.
            generator: source of random numbers, on the CPU.
            triples: number of pixels that are the middle of three in a line at equal distances.
            edges: fraction of the others drawn from the sky's edges: few pixels show where matter
                ends and the sky begins, and the shape of the skyline depends on them.
        """
        free = n - 2 * triples
        pixel = self.anywhere(free, generator)
        if self.edge.numel():
            count = int(edges * (free - triples))
            row = integers(generator, 0, self.edge.shape[0], count, device=self.device)
            pixel[free - count :] = self.edge[row]
        image = torch.searchsorted(self.pixel_start, pixel, right=True) - 1
        within = pixel - self.pixel_start[image]
        in_line = torch.zeros(0, dtype=torch.bool, device=self.device)
        if triples:
            left, right, in_line = self.sides(image[:triples], within[:triples], generator)
            image = torch.cat([image, image[:triples], image[:triples]])
            within = torch.cat([within, left, right])
            pixel = self.pixel_start[image] + within
        width = self.width[image]
        column, row = within % width, within.div(width, rounding_mode="floor")
        xy = torch.stack([(column + 0.5) / width, (row + 0.5) / self.height[image]], dim=-1)
        c2w = self.c2w[image]
        d = self.directions.of(self.camera[image], column, row)
        unknown = torch.full_like(image, UNKNOWN, dtype=torch.uint8)
        return Batch(
            rays_o=c2w[:, :3, 3].contiguous(),
            rays_d=(c2w[:, :3, :3] @ d[:, :, None])[:, :, 0].contiguous(),
            image=image,
            rgb=self.rgb[pixel].float() / 255.0,
            label=unknown if self.label is None else self.label[pixel],
            xy=xy,
            cosine=d[:, 2],
            in_line=in_line,
            relative=None if self.relative is None else self.relative[pixel].float(),
        )

    def anywhere(self, n: int, generator: torch.Generator) -> Int[Tensor, "n"]:
        """Draw n random pixels uniformly from all unmasked ones.

        Masked ones are drawn and rejected: a list of the others would take more memory than the
        photos.
        """
        total = self.rgb.shape[0]
        if self.drawable is None:
            return integers(generator, 0, total, n, device=self.device)
        found = torch.zeros(0, dtype=torch.long, device="cpu")
        while found.shape[0] < n:
            more = min(int((n - found.shape[0]) / self.usable_fraction) + 1, MAX_DRAWN)
            pixel = torch.randint(0, total, (more,), generator=generator, device="cpu")
            found = torch.cat([found, pixel[self.drawable[pixel]]])
        return upload(found[:n], self.device)

    def sides(
        self, image: Int[Tensor, "m"], within: Int[Tensor, "m"], generator: torch.Generator
    ) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"], Bool[Tensor, "m"]]:
        """Return two pixels on opposite sides of each pixel, and whether both may be used.

        Where one lies outside the image or its mask, both are the pixel itself.
        """
        m, device = image.shape[0], self.device
        spacing = self.spacings[integers(generator, 0, len(SPACINGS), m, device=device)]
        step = self.axes[integers(generator, 0, len(self.axes), m, device=device)]
        step = step * spacing[:, None]
        width, height = self.width[image], self.height[image]
        x, y = within % width, within.div(width, rounding_mode="floor")
        inside = (x >= spacing) & (x < width - spacing) & (y >= spacing) & (y < height - spacing)
        shift = (step[:, 0] + step[:, 1] * width) * inside
        if self.usable is not None:
            start = self.pixel_start[image] + within
            inside = inside & self.usable[start - shift] & self.usable[start + shift]
            shift = shift * inside
        return within - shift, within + shift, inside


def in_one_row(
    shapes: Sequence[tuple[int, int]],
    pictures: Iterable[Shaped[np.ndarray, "h w *c"] | None],
    kind: type[np.generic],
    empty: float,
    channels: int | None = None,
) -> tuple[Shaped[np.ndarray, "p *c"], list[Shaped[np.ndarray, "h w *c"]]]:
    """Return all pixels of pictures in one array, and each picture's view of it.

    Beyond `MAX_IN_MEMORY` bytes the array is a temporary file, which the system caches in memory.

    Args:
        shapes: height and width of each picture.
        pictures: taken one at a time; None: missing. If all are missing the array is empty.
        kind: type of the numbers.
        empty: value of missing pictures.
        channels: of each pixel; None: pixels are single numbers.

    Raises:
        ValueError: the number or a size of the pictures differs from `shapes`.
        UserError: the temporary folder is full.
    """
    row, parts = np.empty(0, kind), []
    per_pixel = () if channels is None else (channels,)
    starts = np.cumsum([0] + [h * w for h, w in shapes])
    count = 0
    for count, picture in enumerate(pictures, 1):
        if picture is None or count > len(shapes):
            continue
        if not parts:
            whole = (int(starts[-1]), *per_pixel)
            row = _allocate(whole, np.dtype(kind))
            row.fill(empty)
            spans = zip(starts[:-1], starts[1:], shapes, strict=True)
            parts = [row[a:b].reshape(*shape, *per_pixel) for a, b, shape in spans]
        if picture.shape != parts[count - 1].shape:
            raise ValueError("a picture's size differs from its camera's")
        parts[count - 1][:] = picture
    if count not in (0, len(shapes)):
        raise ValueError(f"{count} pictures for {len(shapes)} cameras")
    return row, parts


def _allocate(shape: tuple[int, ...], kind: np.dtype) -> np.ndarray:
    size = kind.itemsize * int(np.prod(shape))
    if size <= MAX_IN_MEMORY:
        return np.empty(shape, kind)
    try:
        with tempfile.TemporaryFile() as file:  # the map keeps it open; it vanishes with the map
            if hasattr(os, "posix_fallocate"):  # else a full disk is a bus error later
                os.posix_fallocate(file.fileno(), 0, size)
            return np.memmap(file, kind, "w+", shape=shape)
    except OSError as error:
        raise UserError(
            f"{size / 1e9:.1f} GB of pixels do not fit into the folder for temporary files"
            f" ({error.strerror}); set TMPDIR to a folder with room, or fit with --downscale 2"
        ) from error


def in_units(relative: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Return relative depth scaled to a maximum of 1, within the range of half floats."""
    largest = np.max(np.abs(relative), where=np.isfinite(relative), initial=0.0)
    return relative / largest if largest > 0 else relative


def sky_edge(label: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the pixels within `EDGE` of a border between sky and other known classes."""
    sky, other = label == SKY, (label != SKY) & (label != UNKNOWN)
    near = []
    for side in (sky, other):
        padded = np.pad(side, EDGE)
        shifted = [
            padded[r : r + label.shape[0], c : c + label.shape[1]]
            for r in range(2 * EDGE + 1)
            for c in range(2 * EDGE + 1)
        ]
        near.append(np.any(shifted, axis=0))
    return (sky | other) & near[0] & near[1]


def is_ground(label: Int[Tensor, "n"] | UInt8[Tensor, "n"]) -> Bool[Tensor, "n"]:
    """Return which merged classes are ground."""
    return torch.stack([label == kind for kind in GROUND]).any(0)


def is_standing(label: Int[Tensor, "n"] | UInt8[Tensor, "n"]) -> Bool[Tensor, "n"]:
    """Return which merged classes stand on the ground."""
    return torch.stack([label == kind for kind in STANDING]).any(0)

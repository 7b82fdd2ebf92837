"""All training pixels as one long list of rays with their colours."""

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
from climatenerf.core.device import integers, to_device, to_numpy, upload
from climatenerf.core.errors import UserError
from climatenerf.training.evidence.frusta import frustum_planes
from climatenerf.training.evidence.visual_hull import VisualHull
from climatenerf.training.pixel_directions import Directions

SPACINGS = (1, 2, 4, 8)  # pixels between the neighbours of a triple
HORIZON = -0.05  # rays that sink more than this end on matter: levelling is good to a degree or two
SKY_SHARE = 0.1  # of the views that have a place before them: so many must show sky there,
GROUND_SHARE = 0.5  # or ground
STANDING_SHARE = 0.5  # or things that stand on it
AT_MOST = 2**22  # pixels drawn at once where masks hide nearly all
IN_MEMORY = 2_000_000_000  # bytes that the colours of all photos may take there, or their labels
NEARBY = 1  # pixels to all sides whose colours a pixel may have, too, before it counts as wrong
EDGE = 2  # pixels to both sides that are such an edge


@dataclass
class Batch:
    """n rays drawn from the training images.

    The last 2m of them, m = len(in_line), are the two sides of the first m: pixels in one line at
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
    """Merged class of the image's label, 255 unknown."""
    xy: Float[Tensor, "n 2"]
    """Position in the image, (x, y) in (0,1)."""
    cosine: Float[Tensor, "n"]
    """Of the angle between the ray and the optical axis."""
    in_line: Bool[Tensor, "m"]
    """Which of the triples lie in their image, and outside its mask, as a whole."""
    relative: Float[Tensor, "n"] | None
    """Relative inverse z-depth (see `monocular.py`), NaN where unknown; None if there is none."""

    @property
    def is_sky(self) -> Float[Tensor, "n"]:
        """1 where the image's label says sky, else 0."""
        return (self.label == SKY).float()


class TrainingPixels:
    """Draws random pixels from a list of images; keeps 8-bit pixels only."""

    def __init__(
        self,
        cameras: Sequence[Camera],
        camera_of: Sequence[int],
        c2w: Float[np.ndarray, "v 4 4"],
        images: Iterable[UInt8[np.ndarray, "h w 3"]],
        labels: Iterable[UInt8[np.ndarray, "h w"] | None] | None = None,
        masks: Iterable[Shaped[np.ndarray, "h w"] | None] | None = None,
        relative: Iterable[Float[np.ndarray, "h w"] | None] | None = None,
    ):
        """Takes images in the size of their (already downscaled) cameras; c2w in world metres.

        Images, labels, masks and depths are taken one at a time, so a generator saves memory.
        Masks: pixels where a mask is 0 are never drawn, and their labels count as unknown.
        """
        self.c2w = to_device(np.asarray(c2w, np.float32))
        self.cameras = [cameras[i] for i in camera_of]
        self.directions = Directions(cameras)
        self.camera = torch.as_tensor(list(camera_of))
        self.frusta = frustum_planes(self.cameras, c2w)
        self.width = torch.tensor([camera.width for camera in self.cameras])
        self.height = torch.tensor([camera.height for camera in self.cameras])
        counts = self.width * self.height
        self.pixel_start = torch.cat([torch.zeros(1, dtype=torch.long), counts.cumsum(0)])
        shapes = [(camera.height, camera.width) for camera in self.cameras]
        rgb, _ = in_one_row(shapes, images, np.uint8, 0, channels=3)
        self.rgb = to_device(rgb)
        self.usable, self.drawable, self.usable_fraction = None, None, 1.0
        self.spacings = torch.tensor(SPACINGS)
        self.axes = torch.tensor([[1, 0], [0, 1], [1, 1], [1, -1]])
        usable = (None if mask is None else mask > 0 for mask in masks or ())
        flat, shown = in_one_row(shapes, usable, np.bool_, True)
        if flat.size:
            self.usable, self.drawable = to_device(flat), torch.from_numpy(flat)
            self.usable_fraction = int(flat.sum()) / flat.size
        self.label = None
        self.sky_hull = None
        self.edge = torch.zeros(0, dtype=torch.long)
        known = (None if label is None else MERGED[label] for label in labels or ())
        flat, merged = in_one_row(shapes, known, np.uint8, UNKNOWN)
        for image, own in enumerate(merged):
            if shown:  # what a mask hides says nothing of what is empty, either
                own[~shown[image]] = UNKNOWN
            # Networks take puddles and wet walls for the sky that they mirror.
            row, column = np.nonzero(own == SKY)
            place = to_device(column), to_device(row)
            d = self.directions.of(self.camera[image].expand(len(row)), *place)
            low = to_numpy(d @ self.c2w[image, 2, :3] < HORIZON)
            own[row[low], column[low]] = UNKNOWN
        if (flat != UNKNOWN).any():  # labels that know nothing are none
            self.label = to_device(flat)
        if self.label is not None and bool((self.label == SKY).any()):
            at = [np.flatnonzero(sky_edge(each)) for each in merged]
            starts = to_numpy(self.pixel_start)[:-1]
            self.edge = to_device(np.concatenate([e + s for e, s in zip(at, starts, strict=True)]))
            self.sky_hull = VisualHull(self.cameras, c2w, merged, [SKY], SKY_SHARE)
        self.ground_hull = self.obstacle_hull = None
        if self.label is not None and bool(
            torch.isin(self.label, torch.tensor(GROUND, dtype=torch.uint8)).any()
        ):
            self.ground_hull = VisualHull(self.cameras, c2w, merged, GROUND, GROUND_SHARE)
            self.obstacle_hull = VisualHull(self.cameras, c2w, merged, STANDING, STANDING_SHARE)
        scaled = (None if depth is None else in_units(depth) for depth in relative or ())
        flat, _ = in_one_row(shapes, scaled, np.float16, np.nan)
        self.relative = to_device(flat) if flat.size else None

    def without_sky(self) -> "TrainingPixels":
        """The same pixels, with what is labelled sky unknown."""
        other = copy.copy(self)
        other.sky_hull, other.edge = None, self.edge[:0]
        if self.label is not None:
            other.label = torch.where(self.label == SKY, UNKNOWN, self.label).to(torch.uint8)
        return other

    def xy_towards(
        self, image: Int[Tensor, "n"], rays_d: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n 2"]:
        """Where in its picture, (x, y) in (0,1), an image shows a direction; NaN outside it."""
        out = torch.full((image.shape[0], 2), torch.nan)
        for i in to_numpy(image.unique()).tolist():
            some = (image == i).nonzero()[:, 0]
            camera = self.cameras[i]
            pixel = camera.project(to_numpy(rays_d[some] @ self.c2w[i, :3, :3]))
            place = pixel / (camera.width, camera.height)
            with np.errstate(invalid="ignore"):  # behind the camera: NaN
                inside = np.all((place >= 0) & (place < 1), axis=-1)
            out[some[to_device(inside)]] = to_device(place[inside].astype(np.float32))
        return out

    def pixel_towards(
        self, image: Int[Tensor, "n"], rays_d: Float[Tensor, "n 3"]
    ) -> tuple[Bool[Tensor, "n"], Int[Tensor, "k"]]:
        """Whether images show directions at all, and the pixels of those that they show."""
        place = self.xy_towards(image, rays_d)
        inside = ~place[:, 0].isnan()
        image, place = image[inside], place[inside]
        width, height = self.width[image], self.height[image]
        # Rounding may bring the last pixel's border to 1.
        x = (place[:, 0] * width).long().minimum(width - 1)
        y = (place[:, 1] * height).long().minimum(height - 1)
        return inside, self.pixel_start[image] + y * width + x

    def label_towards(
        self, image: Int[Tensor, "n"], rays_d: Float[Tensor, "n 3"]
    ) -> UInt8[Tensor, "n"]:
        """Merged class that an image's label has in a direction; unknown outside the picture."""
        out = torch.full_like(image, UNKNOWN, dtype=torch.uint8)
        if self.label is not None:
            inside, pixel = self.pixel_towards(image, rays_d)
            out[inside] = self.label[pixel]
        return out

    def usable_towards(
        self, image: Int[Tensor, "n"], rays_d: Float[Tensor, "n 3"]
    ) -> Bool[Tensor, "n"]:
        """Whether no mask hides what an image shows in a direction."""
        out = torch.ones_like(image, dtype=torch.bool)
        if self.usable is not None:
            inside, pixel = self.pixel_towards(image, rays_d)
            out[inside] = self.usable[pixel]
        return out

    def colours_nearby(
        self, image: Int[Tensor, "n"], place: Float[Tensor, "n 2"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Least and largest display sRGB, by channel, of the pixels up to `NEARBY` away."""
        width, height = self.width[image], self.height[image]
        x, y = (place[:, 0] * width).long(), (place[:, 1] * height).long()
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

    def kinds(self) -> UInt8[Tensor, "k"]:
        """Merged classes that any pixel is labelled as, with unknown if some are; none without."""
        if self.label is None:
            return torch.zeros(0, dtype=torch.uint8)
        # Piece by piece: to sort all labels would take twenty times their room.
        pieces = [torch.bincount(each.long(), minlength=256) for each in self.label.split(AT_MOST)]
        return torch.stack(pieces).sum(0).nonzero()[:, 0].to(torch.uint8)

    def draw(
        self, n: int, generator: torch.Generator, triples: int = 0, edges: float = 0.0
    ) -> Batch:
        """n random pixels.

        Args:
            n: how many.
            generator: of randomness.
            triples: as many of them are the middle of three in a line at equal distances.
            edges: share of the rest that is drawn from the sky's edges: few pixels show where
                matter ends and the sky begins, and much hangs on them.
        """
        free = n - 2 * triples
        pixel = self.anywhere(free, generator)
        if self.edge.numel():
            count = int(edges * (free - triples))
            chosen = integers(generator, 0, self.edge.shape[0], count)
            pixel[free - count :] = self.edge[chosen]
        image = torch.searchsorted(self.pixel_start, pixel, right=True) - 1
        within = pixel - self.pixel_start[image]
        in_line = torch.zeros(0, dtype=torch.bool)
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
        unknown = torch.full((n,), UNKNOWN, dtype=torch.uint8)
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
        """n random pixels of all that no mask hides, all alike.

        Hidden ones are drawn and left out: a list of the others would take more than the photos.
        """
        total = self.rgb.shape[0]
        if self.drawable is None:
            return integers(generator, 0, total, n)
        found = torch.zeros(0, dtype=torch.long, device="cpu")
        while found.shape[0] < n:
            more = min(int((n - found.shape[0]) / self.usable_fraction) + 1, AT_MOST)
            pixel = torch.randint(0, total, (more,), generator=generator, device="cpu")
            found = torch.cat([found, pixel[self.drawable[pixel]]])
        return upload(found[:n])

    def sides(
        self, image: Int[Tensor, "m"], within: Int[Tensor, "m"], generator: torch.Generator
    ) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"], Bool[Tensor, "m"]]:
        """Two pixels on opposite sides of each pixel, and whether both may be drawn.

        Where one lies outside the image or its mask, the pixel itself stands for both.
        """
        m = image.shape[0]
        spacing = self.spacings[integers(generator, 0, len(SPACINGS), m)]
        step = self.axes[integers(generator, 0, len(self.axes), m)] * spacing[:, None]
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
    """All pixels of pictures (h, w) in one row, and each picture's part of it; nothing if all lack.

    Above `IN_MEMORY` bytes it is a temporary file, of which the system keeps in memory what it can.

    Args:
        shapes: height and width of each picture.
        pictures: taken one at a time; None: `empty` throughout.
        kind: of the numbers.
        empty: what stands where a picture lacks.
        channels: of each pixel; None: pixels are single numbers.
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
            row = _room(whole, np.dtype(kind))
            row.fill(empty)
            spans = zip(starts[:-1], starts[1:], shapes, strict=True)
            parts = [row[a:b].reshape(*shape, *per_pixel) for a, b, shape in spans]
        if picture.shape != parts[count - 1].shape:
            raise ValueError("a picture's size differs from its camera's")
        parts[count - 1][:] = picture
    if count not in (0, len(shapes)):
        raise ValueError(f"{count} pictures for {len(shapes)} cameras")
    return row, parts


def _room(shape: tuple[int, ...], kind: np.dtype) -> np.ndarray:
    size = kind.itemsize * int(np.prod(shape))
    if size <= IN_MEMORY:
        return np.empty(shape, kind)
    try:
        with tempfile.TemporaryFile() as file:  # the map holds it, and with the map it is gone
            if hasattr(os, "posix_fallocate"):  # a full disk would be a bus error later
                os.posix_fallocate(file.fileno(), 0, size)
            return np.memmap(file, kind, "w+", shape=shape)
    except OSError as error:
        raise UserError(
            f"{size / 1e9:.1f} GB of pixels do not fit into the folder for temporary files"
            f" ({error.strerror}); set TMPDIR to a folder with room, or fit with --downscale 2"
        ) from error


def in_units(relative: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Relative depth with 1 as its largest value: its scale is free, and half floats are not."""
    largest = np.max(np.abs(relative), where=np.isfinite(relative), initial=0.0)
    return relative / largest if largest > 0 else relative


def sky_edge(label: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels within `EDGE` of the border between sky and what is known not to be sky."""
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

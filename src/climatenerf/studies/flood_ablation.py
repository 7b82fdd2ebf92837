"""Ablation of the flood, after the paper's: each row leaves one part of the simulation out.

The rows change the prepared water, not its physics: a subclass answers differently in one respect,
or the scene is turned. Each row has a number that shows its fault.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import stats
from scipy.spatial.transform import Rotation
from torch import Tensor

from climatenerf.core.cameras import Camera
from climatenerf.core.device import to_device, to_numpy
from climatenerf.core.errors import UserError
from climatenerf.core.srgb import LUMA, to_display
from climatenerf.evaluation.metrics import psnr
from climatenerf.field.compositing import composited
from climatenerf.field.protocol import device_of
from climatenerf.render.frame import FrameOptions, encoded_8bit, see_frame, traced_rays
from climatenerf.render.integrator import trace
from climatenerf.scene import Scene
from climatenerf.studies.shot import Place, Shot
from climatenerf.studies.study_folder import Row
from climatenerf.studies.sweep import difference
from climatenerf.studies.turned_field import Turn, TurnedField
from climatenerf.weather.flood.surface import Water
from climatenerf.weather.world import RaySamples, SurfaceHits, TraceRadiance, World

ROWS = ("tilted plane", "no waves", "no Fresnel", "no gloss", "no anti-aliasing", "full")
WEATHER = "flood-waves"  # of the reference set
WATER = 0.99  # fraction of water from which a pixel counts as water
MIN_PIXELS = 100  # of water, for numbers about it
POINT = 1e-6  # rad; of a ray without a footprint
FAR_PIXELS, FAR_SAMPLES = 400, 8  # pixels compared with so many samples along each side
MIN_SHARE = 1e-3  # of light reflected and transmitted; less cannot be scaled up
ROUNDING = 1e-5  # standard deviation that rounding gives to a constant
TILT, TILT_RATIO = 0.5, 3.0  # deg of the full row at most; tilt of the row over it
# dB. Reflected rays are marched in coarser steps than those of the mirrored camera: 29 dB on a
# fitted street, where waves leave 9. A field in closed form is equal.
MIRROR, EXACT = 25.0, 99.0
CORRELATION = 0.9  # of reflectance with incidence, of the full row at least
SHARPER = 1.1  # gradient energy of reflections without gloss over the full row's
NOISIER = 2.0  # error of far water without anti-aliasing over the full row's


class Mirror(Water):
    """Water that reflects one ray for each pixel, at the slope of its centre."""

    def reflected_rays(self) -> int:
        """One."""
        return 1


@dataclass(frozen=True)
class EvenWater(Water):
    """Water that reflects the same fraction of light in all directions.

    Attributes:
        reflectance: that fraction.
    """

    reflectance: float = 0.0

    def shade(
        self, world: World, hits: SurfaceHits, trace: TraceRadiance
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], dict[str, Float[Tensor, "n"]]]:
        """Reflection and body of the water, mixed anew."""
        shaded, normal, layers = super().shade(world, hits, trace)
        rest, own = split_by_reflection(super().shade, world, hits)
        # Where nothing is reflected or transmitted, there is nothing to scale.
        reflected = (shaded - rest) / own.clamp_min(MIN_SHARE)
        passed = rest / (1 - own).clamp_min(MIN_SHARE)
        mixed = self.reflectance * reflected + (1 - self.reflectance) * passed
        return mixed, normal, layers


class UnfilteredWater(Water):
    """Water whose waves and shore are looked up at a point, not over a pixel."""

    def distance(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        pixel_angle: Float[Tensor, "n"],
    ) -> Float[Tensor, "n"]:
        """Ray length to the surface of the unfiltered waves, m."""
        return super().distance(rays_o, rays_d, torch.full_like(pixel_angle, POINT))

    def fraction_behind(
        self,
        world: World,
        along: RaySamples,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t: Float[Tensor, "n"],
        pixel_angle: Float[Tensor, "n"],
    ) -> Float[Tensor, "s"]:
        """Fraction of each sample behind the surface, with a hard edge."""
        point = torch.full_like(pixel_angle, POINT)
        return super().fraction_behind(world, along, rays_o, rays_d, t, point)

    def shade(
        self, world: World, hits: SurfaceHits, trace: TraceRadiance
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], dict[str, Float[Tensor, "n"]]]:
        """What the point of the surface shows that the ray meets."""
        point = torch.full_like(hits.pixel_angle, POINT)
        return super().shade(world, replace(hits, pixel_angle=point), trace)


def split_by_reflection(
    shade: Callable[..., tuple], world: World, hits: SurfaceHits
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 1"]]:
    """Return what water shows in a black world, and the fraction of light that it reflects.

    What water shows is linear in the radiance that it reflects: it is asked with a black and with
    a white one.
    """

    def even(value: float) -> TraceRadiance:
        return lambda o, d, angle: torch.full_like(o, value)

    black, white = (shade(world, hits, even(value))[0] for value in (0.0, 1.0))
    return black, (white - black).mean(-1, keepdim=True).clamp(0, 1)


Kind = TypeVar("Kind", bound=Water)


def as_kind(kind: type[Kind], water: Water, reflectance: float | None = None) -> Kind:
    """Return the same water as one of its subclasses."""
    given = {each.name: getattr(water, each.name) for each in fields(Water)}
    if reflectance is not None:
        given["reflectance"] = reflectance
    return kind(**given)


@dataclass(frozen=True)
class Seen:
    """One row's world and picture.

    Attributes:
        world: what was rendered.
        c2w: pose of the camera in that world.
        linear: linear radiance.
        layers: of the picture; normals in the axes of that world.
    """

    world: World
    c2w: Float[np.ndarray, "4 4"]
    linear: Float[Tensor, "h w 3"]
    layers: dict[str, np.ndarray]

    @property
    def wet(self) -> Bool[np.ndarray, "h w"]:
        """Pixels of water."""
        return self.layers["mask_water"] > WATER


def mean_camera_up(scene: Scene) -> Float[np.ndarray, "3"]:
    """Return the mean of the cameras' own up, a unit vector: up without a vanishing point."""
    poses = np.stack([scene.c2w_world(view) for view in scene.of_split("train")])
    up = -poses[:, :3, 1].mean(0)
    return up / np.linalg.norm(up)


def flood_ablation(shot: Shot, progress: Callable[[str], None]) -> list[Row]:
    """Render the rows of a flood and measure their faults.

    Args:
        shot: camera, weather with a flood, and truth if it is known.
        progress: called with each row as it begins.

    Raises:
        UserError: the picture shows no water.
    """
    world = shot.session().world(shot.time)
    water = water_of(world)

    def seen(name: str, changed: Water) -> Seen:
        progress(name)
        return see(replace(world, surfaces=(changed,)), shot)

    full = seen("full", water)
    if full.wet.sum() < MIN_PIXELS:
        raise UserError(
            f"the picture of {shot.view} shows too little water; choose another photo with --view,"
            " or a higher level in a weather file with --weather"
        )
    mean = float(reflectance_at(full, shot.camera)[0].mean())
    rows = {
        "tilted plane": tilted(shot, progress),
        "no waves": still(shot, progress),
        "no Fresnel": seen("no Fresnel", as_kind(EvenWater, water, mean)),
        "no gloss": seen("no gloss", as_kind(Mirror, water)),
        "no anti-aliasing": seen("no anti-aliasing", as_kind(UnfilteredWater, water)),
        "full": full,
    }
    progress("far water")
    far = FarWater.of(full, shot, as_kind(UnfilteredWater, water))
    metrics = {name: measured(each, full, shot, far) for name, each in rows.items()}
    return [
        Row(name, encoded_8bit(rows[name].linear), metrics[name], *verdict(name, metrics))
        for name in ROWS
    ]


def water_of(world: World) -> Water:
    """Return the flood of a world."""
    water = world.surfaces[0]
    assert isinstance(water, Water), "the caller gives a weather with a flood and no other surface"
    return water


def see(world: World, shot: Shot) -> Seen:
    """Render a world with normals."""
    options = FrameOptions(normals=True)
    return Seen(world, shot.c2w, *see_frame(world, shot.camera, shot.c2w, options))


def still(shot: Shot, progress: Callable[[str], None]) -> Seen:
    """Render the flood without wind."""
    progress("no waves")
    calm = shot.weather.with_value("flood.wind_speed", 0.0)
    return see(shot.session(calm).world(shot.time), shot)


def tilted(shot: Shot, progress: Callable[[str], None]) -> Seen:
    """Render the flood with the mean camera's up in place of gravity's.

    The scene is turned as a wrong up would turn it, about the point of the water below the mean of
    the cameras, where the level stays.
    """
    progress("tilted plane")
    place, scene = shot.place, shot.place.scene
    turn = turn_of(scene, shot.weather.flood.level)
    moved = replace(scene, world_from_input=turn.matrix() @ scene.world_from_input)
    field = TurnedField(place.field, turn)
    turned = Place(field, moved, style=place.style)  # its light is not that of the run
    c2w = turn.matrix() @ shot.c2w
    other = replace(shot, place=turned, c2w=c2w)
    return see(other.session().world(shot.time), other)


def turn_of(scene: Scene, level: float) -> Turn:
    """Return the turn that puts the mean camera's up upright; the level is over the datum, m."""
    up, eyes = mean_camera_up(scene), [scene.c2w_world(v)[:3, 3] for v in scene.of_split("train")]
    pivot = np.mean(eyes, axis=0)
    pivot[2] = scene.ground_z + level
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(axis)
    # 1e-12: an up that is upright already has no axis.
    rotation = Rotation.from_rotvec(axis / max(sine, 1e-12) * np.arctan2(sine, up[2]))
    return Turn(rotation.as_matrix(), pivot)


# --- the numbers ----------------------------------------------------------------------------------


def measured(seen: Seen, full: Seen, shot: Shot, far: "FarWater") -> dict[str, float]:
    """Return the numbers of a row; each is NaN where it is not known."""
    picture = encoded_8bit(seen.linear)
    found = {
        "difference_from_full_255": difference(picture, encoded_8bit(full.linear)),
        "water_share": float(seen.layers["mask_water"].mean()),
    }
    if seen.wet.sum() < MIN_PIXELS:
        names = ("tilt_deg", "normal_deviation_deg", "reflectance_correlation", "gradient_energy")
        found |= dict.fromkeys((*names, "mirror_psnr_db"), float("nan"))
    else:
        found |= {
            "tilt_deg": plane_tilt(seen, shot),
            "normal_deviation_deg": normal_deviation(seen),
            "reflectance_correlation": rank_correlation(*reflectance_at(seen, shot.camera)),
            "gradient_energy": gradient_energy(seen),
            "mirror_psnr_db": mirror_psnr(seen, shot.camera),
        }
    found["far_error"] = far.error(seen)
    if shot.truth is not None:
        pixels = shot.truth.water()
        true = shot.truth.picture()[pixels]
        found["psnr_water_db"] = psnr((picture / 255.0)[pixels][None], true[None])
    return found


def plane_tilt(seen: Seen, shot: Shot) -> float:
    """Return the angle between gravity and the plane through the water that is seen, degrees."""
    x = (seen.layers["depth"][..., None] * shot.directions())[seen.wet].astype(np.float64)
    design = np.column_stack([x[:, :2], np.ones(len(x))])
    slope = np.linalg.lstsq(design, x[:, 2], rcond=None)[0][:2]
    return float(np.degrees(np.arctan(np.linalg.norm(slope))))


def normal_deviation(seen: Seen) -> float:
    """Return the RMS angle between the water's normals and their mean, degrees."""
    normal = seen.layers["normal"][seen.wet].astype(np.float64)
    mean = normal.mean(0)
    mean = mean / np.linalg.norm(mean)
    # The sine is exact for small angles, where the cosine rounds to 1.
    sine = np.linalg.norm(np.cross(normal, mean), axis=-1).clip(0, 1)
    return float(np.degrees(np.sqrt(np.mean(np.arcsin(sine) ** 2))))


def reflectance_at(
    seen: Seen, camera: Camera
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return the fraction of light that each pixel of water reflects, and its incidence, rad.

    The incidence is that on the slope that the pixel shows.
    """
    wet = torch.from_numpy(seen.wet.ravel()).nonzero()[:, 0]
    device = device_of(seen.world.field)
    o, d, angle = (each[wet] for each in traced_rays(camera, seen.c2w, device))
    t = to_device(seen.layers["depth"].ravel()[to_numpy(wet)].astype(np.float32), device)
    water = water_of(seen.world)
    _, share = split_by_reflection(
        water.shade, seen.world, SurfaceHits(o, d, t, torch.zeros_like(t), angle)
    )
    facing = -(to_numpy(d) * seen.layers["normal"][seen.wet]).sum(-1)
    return to_numpy(share[:, 0]), np.arccos(np.clip(facing, -1, 1))


def mirror_psnr(seen: Seen, camera: Camera) -> float:
    """Return how well the mirror image in the water is that of the mirrored camera, dB.

    The water of some pixels reflects all light, and is compared with what the mirrored camera sees
    of the field above the level.
    """
    rows, columns = np.nonzero(seen.wet)
    chosen = np.linspace(0, len(rows) - 1, min(FAR_PIXELS, len(rows))).astype(int)
    index = torch.from_numpy(rows[chosen] * camera.width + columns[chosen])
    world, water = seen.world, water_of(seen.world)
    device = device_of(world.field)
    o, d, angle = (each[index] for each in traced_rays(camera, seen.c2w, device))
    t = to_device(seen.layers["depth"][rows[chosen], columns[chosen]].astype(np.float32), device)
    perfect = replace(world, surfaces=(replace(water, mirror_only=True),))
    reflected = trace(perfect, o, d, angle).rgb
    below, up = o.clone(), d.clone()
    below[:, 2] = 2 * water.level - o[:, 2]
    up[:, 2] = -d[:, 2]
    image, left, _ = composited(world.field, below, up, t, appearance=world.appearance)
    sky = world.field.sky(up, world.appearance)
    if world.light is not None:
        sky = world.light.reflected_sky(up, sky)
    image = image + left[:, None] * sky
    pair = (to_display(to_numpy(each))[None] for each in (reflected, image))
    return min(psnr(*pair), EXACT)


def rank_correlation(one: Float[np.ndarray, "n"], other: Float[np.ndarray, "n"]) -> float:
    """Return Spearman's correlation, which is 1 for any rising curve; 0 for a constant."""
    if min(a.std() for a in (one, other)) < ROUNDING:
        return 0.0
    return float(np.corrcoef(stats.rankdata(one), stats.rankdata(other))[0, 1])


def gradient_energy(seen: Seen) -> float:
    """Return the mean squared change of display luma between neighbouring pixels of water."""
    grey, wet = to_display(to_numpy(seen.linear)) @ LUMA, seen.wet
    pairs = (
        (grey[:, 1:] - grey[:, :-1])[wet[:, 1:] & wet[:, :-1]],
        (grey[1:] - grey[:-1])[wet[1:] & wet[:-1]],
    )
    return float(np.mean(np.concatenate(pairs) ** 2))


@dataclass(frozen=True)
class FarWater:
    """Some pixels of the farther half of the water, finely sampled.

    Attributes:
        pixels: rows and columns.
        true: display values of the mean of the samples.
    """

    pixels: tuple[np.ndarray, np.ndarray]
    true: Float[np.ndarray, "n 3"]

    @classmethod
    def of(cls, full: Seen, shot: Shot, unfiltered: Water) -> "FarWater":
        """Trace the samples of pixels, spread evenly over the farther half."""
        depth = np.where(full.wet, full.layers["depth"], -1.0)
        rows, columns = np.nonzero(depth >= np.median(depth[full.wet]))
        chosen = np.linspace(0, len(rows) - 1, min(FAR_PIXELS, len(rows))).astype(int)
        rows, columns = rows[chosen], columns[chosen]
        fine = shot.camera.resized(
            shot.camera.width * FAR_SAMPLES, shot.camera.height * FAR_SAMPLES
        )
        o, d, angle = traced_rays(fine, full.c2w, device_of(full.world.field))
        inside = np.arange(FAR_SAMPLES)
        y = rows[:, None, None] * FAR_SAMPLES + inside[:, None]
        x = columns[:, None, None] * FAR_SAMPLES + inside
        index = torch.from_numpy((y * fine.width + x).ravel())
        world = replace(full.world, surfaces=(unfiltered,))
        rgb = to_numpy(trace(world, o[index], d[index], angle[index]).rgb)
        return cls((rows, columns), to_display(rgb.reshape(len(rows), -1, 3).mean(1)))

    def error(self, seen: Seen) -> float:
        """Return the RMS difference of a row from the samples, display values."""
        shown = to_display(to_numpy(seen.linear)[self.pixels])
        return float(np.sqrt(np.mean((shown - self.true) ** 2)))


# --- what the numbers must show -------------------------------------------------------------------


def verdict(name: str, metrics: dict[str, dict[str, float]]) -> tuple[str, bool]:
    """Return the sentence with the number that must show a row's fault, and whether it does."""
    own, full = metrics[name], metrics["full"]
    differs = name == "full" or own["difference_from_full_255"] > 0
    text, shown = _VERDICTS[name](own, full)
    if name == "full" and "psnr_water_db" in full:
        better = [n for n in ROWS if metrics[n]["psnr_water_db"] > full["psnr_water_db"]]
        text += f"; PSNR on true water {full['psnr_water_db']:.2f} dB"
        text += f", which {', '.join(better)} exceeds" if better else ", the best of all rows"
    return (text if differs else "the picture equals that of the full row"), shown and differs


def _tilt(own: dict[str, float], full: dict[str, float]) -> tuple[str, bool]:
    tilt, usual = own["tilt_deg"], full["tilt_deg"]
    flooded = 100 * (own["water_share"] / full["water_share"] - 1)
    text = f"tilt {tilt:.2f} deg against {usual:.2f}; flooded pixels {flooded:+.1f} %"
    if np.isnan(tilt):  # the plane has left the picture
        text = f"flooded pixels {flooded:+.1f} %, too few to measure a tilt"
    return text, usual < TILT and (np.isnan(tilt) or tilt > TILT_RATIO * usual)


def _deviation(own: dict[str, float], full: dict[str, float]) -> tuple[str, bool]:
    one, other = own["normal_deviation_deg"], full["normal_deviation_deg"]
    image = own["mirror_psnr_db"]
    text = f"deviation of normals {one:.2g} deg against {other:.2g}; mirror image {image:.1f} dB"
    return text, one == 0 < other and image > MIRROR


def _fresnel(own: dict[str, float], full: dict[str, float]) -> tuple[str, bool]:
    one, other = own["reflectance_correlation"], full["reflectance_correlation"]
    text = f"correlation of reflectance with incidence {one:.2f} against {other:.2f}"
    return text, abs(one) < 0.01 and other > CORRELATION


def _gloss(own: dict[str, float], full: dict[str, float]) -> tuple[str, bool]:
    ratio = own["gradient_energy"] / full["gradient_energy"]
    return f"gradient energy of the water {ratio:.2f} times the full row's", ratio >= SHARPER


def _aliasing(own: dict[str, float], full: dict[str, float]) -> tuple[str, bool]:
    ratio = own["far_error"] / full["far_error"]
    samples = FAR_SAMPLES**2
    text = f"far water differs {ratio:.2f} times as much from {samples} samples a pixel"
    return text, ratio >= NOISIER


def _full(own: dict[str, float], full: dict[str, float]) -> tuple[str, bool]:
    tilt, found = full["tilt_deg"], full["reflectance_correlation"]
    return f"tilt {tilt:.2f} deg, correlation {found:.2f}", tilt < TILT and found > CORRELATION


_VERDICTS: dict[str, Callable[[dict[str, float], dict[str, float]], tuple[str, bool]]] = dict(
    zip(ROWS, (_tilt, _deviation, _fresnel, _gloss, _aliasing, _full), strict=True)
)

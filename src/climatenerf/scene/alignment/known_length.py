"""Scale from lengths that the user knows: a door, a kerb, a parking bay, marked in pictures.

Marks are a TOML file, pixels (x right, y down) of the scene's pictures:

    [DOOR.from]
    "0012.jpg" = [812, 440]
    "0017.jpg" = [700, 431]
    [DOOR.to]
    "0012.jpg" = [815, 902]
    "0017.jpg" = [704, 871]
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from climatenerf.core.errors import UserError
from climatenerf.scene.alignment.scale import rescaled, with_scale_evidence
from climatenerf.scene.scene import Scene

FILE_NAME = "marks.toml"
MIN_ANGLE = 1.0  # degrees between the rays to a mark: below, its distance is a guess
CLICK = 2.0  # pixels: how well an end is marked, on each axis
MIN_ERROR = 0.005  # a mark is never better than this share of the length
DISAGREEMENT = 0.1  # between two known lengths, from which the user is warned

Marks = dict[str, dict[str, dict[str, tuple[float, float]]]]


@dataclass(frozen=True)
class Measured:
    """A known length as the scene has it.

    Attributes:
        name: of the marks.
        known: m, as the user says.
        found: m, in the scene's present scale.
        error: relative standard error of `found`.
    """

    name: str
    known: float
    found: float
    error: float


def read_marks(path: Path) -> Marks:
    """Marks by name, end ("from", "to") and picture.

    Raises:
        UserError: no such file, not TOML, or not of the form above.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(
            f"{path} does not exist; mark both ends of the length in two pictures or more (open"
            " mark.html in the scene folder, which capture makes, or write it by hand as"
            " docs/formats.md says) and save the result there"
        ) from None
    except (OSError, ValueError) as error:
        raise UserError(f"the marks {path} are no readable TOML ({error}); correct them") from None
    marks: Marks = {}
    for name, ends in table.items():
        if not isinstance(ends, Mapping) or set(ends) != {"from", "to"}:
            raise UserError(f"[{name}] in {path} wants the two tables [{name}.from], [{name}.to]")
        marks[name] = {}
        for end, pictures in ends.items():
            if not isinstance(pictures, Mapping) or len(pictures) < 2:
                raise UserError(f"[{name}.{end}] in {path} wants marks in two pictures or more")
            marks[name][end] = {k: _pixel(v, name, end, path) for k, v in pictures.items()}
    return marks


def _pixel(value: object, name: str, end: str, path: Path) -> tuple[float, float]:
    if isinstance(value, list) and len(value) == 2:
        numbers = [x for x in value if isinstance(x, int | float) and not isinstance(x, bool)]
        if len(numbers) == 2 and np.isfinite(numbers).all():
            return float(numbers[0]), float(numbers[1])
    raise UserError(f"[{name}.{end}] in {path} wants pixels such as [812, 440]; got {value!r}")


def measure(scene: Scene, marks: Marks, name: str, known: float) -> Measured:
    """The marked length in the scene's present metres, beside the `known` one in true metres.

    Raises:
        UserError: no such marks, a picture that the scene lacks, or rays that do not meet.
    """
    if name not in marks:
        listed = ", ".join(marks) or "none"
        raise UserError(f"the marks hold no {name!r}; they hold: {listed}")
    ends, errors = [], []
    for end in ("from", "to"):
        place, error = _meet(scene, marks[name][end], f"{name}.{end}")
        ends.append(place)
        errors.append(error)
    found = float(np.linalg.norm(ends[1] - ends[0]))
    if not found > 0:
        raise UserError(f"both ends of {name!r} are marked at one place; mark them anew")
    error = float(np.hypot(*errors)) / found
    return Measured(name, known, found, max(error, MIN_ERROR))


def _meet(
    scene: Scene, pictures: Mapping[str, tuple[float, float]], where: str
) -> tuple[Float[np.ndarray, "3"], float]:
    """The point closest to the rays through a mark, m, and its standard error, m."""
    by_name = {view.name: view for view in scene.views}
    origins, directions, focals = [], [], []
    for picture, pixel in pictures.items():
        if picture not in by_name:
            raise UserError(
                f"[{where}] names the picture {picture}, which the scene lacks; its pictures are"
                f" called like {scene.views[0].name}"
            )
        view = by_name[picture]
        camera, c2w = scene.cameras[view.camera], scene.c2w_world(view)
        if not (0 <= pixel[0] <= camera.width and 0 <= pixel[1] <= camera.height):
            raise UserError(
                f"[{where}] lies outside {picture}, which has {camera.width}x{camera.height} pixels"
            )
        origins.append(c2w[:3, 3])
        focals.append(camera.fx)
        directions.append(camera.directions(np.array(pixel)) @ c2w[:3, :3].T)
    o, d = np.array(origins), np.array(directions)
    widest = np.degrees(np.arccos(np.clip((d @ d.T).min(), -1, 1)))
    if widest < MIN_ANGLE:
        raise UserError(
            f"[{where}] is marked in pictures from nearly one place ({widest:.1f} degrees apart);"
            " mark it in pictures taken further apart"
        )
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    information = across.sum(0)
    place = np.linalg.solve(information, np.einsum("nij,nj->i", across, o))
    away = np.einsum("nij,nj->ni", across, place - o)
    if (((place - o) * d).sum(-1) <= 0).any():
        raise UserError(f"the rays through [{where}] meet behind a camera; mark it anew")
    # Two rays have one degree of freedom beyond the point, each further ray two more: so few may
    # meet by chance, and nobody clicks better than some pixels.
    variance = (away**2).sum() / max(2 * len(o) - 3, 1)
    clicks = CLICK / np.array(focals) * np.linalg.norm(place - o, axis=-1)
    variance = max(variance, float((clicks**2).mean()))
    return place, float(np.sqrt(variance * np.trace(np.linalg.inv(information)) / 3))


def apply_known_lengths(scene: Scene, measured: list[Measured]) -> Scene:
    """The scene in the metres that the known lengths ask for, about its ground datum.

    Several are averaged with weights 1 / error^2; where they disagree a warning says so.
    """
    ratio = np.array([m.known / m.found for m in measured])
    error = np.array([m.error for m in measured])
    weight = 1 / error**2
    factor = float((ratio * weight).sum() / weight.sum())
    spread = float(np.abs(ratio / factor - 1).max())
    combined = max(float(1 / np.sqrt(weight.sum())), spread)
    out = rescaled(scene, factor, "known-length", combined)
    for m, r in zip(measured, ratio, strict=True):
        if len(measured) > 1:
            out = with_scale_evidence(out, m.name, float(r) / factor, m.error)
    if spread > DISAGREEMENT:
        told = ", ".join(f"{m.name} x{r:.2f}" for m, r in zip(measured, ratio, strict=True))
        warning = f"The known lengths disagree ({told}); check their marks."
        out = replace(out, warnings=(*out.warnings, warning))
    return out

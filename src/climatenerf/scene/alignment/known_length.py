"""Scale from known lengths, such as a door, a kerb or a parking bay, marked in images.

Marks are a TOML file of pixels (x right, y down) in the scene's images:

    [DOOR.from]
    "0012.jpg" = [812, 440]
    "0017.jpg" = [700, 431]
    [DOOR.to]
    "0012.jpg" = [815, 902]
    "0017.jpg" = [704, 871]
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from climatenerf.core.errors import UserError, excerpt
from climatenerf.core.parsing import read_toml
from climatenerf.scene.alignment.scale import rescaled, with_scale_evidence
from climatenerf.scene.findings import Finding
from climatenerf.scene.scene import Scene

FILE_NAME = "marks.toml"
MIN_ANGLE = 1.0  # degrees between the rays to a mark: below, the distance is undetermined
CLICK_SIGMA = 2.0  # pixels: error of a mark along each axis
MIN_ERROR = 0.005  # relative, of a measured length
DISAGREEMENT = 0.1  # relative difference of known lengths that is worth a warning

Marks = dict[str, dict[str, dict[str, tuple[float, float]]]]


@dataclass(frozen=True)
class LengthMeasurement:
    """A known length, measured in the scene.

    Attributes:
        name: Name of the marks.
        true: Length according to the user, m.
        measured: Length in the scene at its present scale, m.
        error: Relative standard error of `measured`.
    """

    name: str
    true: float
    measured: float
    error: float


def read_marks(path: Path) -> Marks:
    """Read marks as pixels by name, end ("from", "to") and image name.

    Raises:
        UserError: The file is absent, not TOML, or not of the form above.
    """
    if not path.exists():
        raise UserError(
            f"{path} does not exist; mark both ends of the length in two images or more (open"
            " mark.html in the scene folder, which capture makes, or write the file as"
            " docs/formats.md describes) and save the result there"
        )
    table = read_toml(path, "the marks")
    marks: Marks = {}
    for name, ends in table.items():
        if not isinstance(ends, Mapping) or set(ends) != {"from", "to"}:
            raise UserError(
                f"[{name}] in {path} must have the two tables [{name}.from] and [{name}.to]; add"
                " them"
            )
        marks[name] = {}
        for end, images in ends.items():
            if not isinstance(images, Mapping) or len(images) < 2:
                raise UserError(
                    f"[{name}.{end}] in {path} has fewer than two marks; mark it in two images or"
                    " more"
                )
            marks[name][end] = {k: _pixel(v, name, end, path) for k, v in images.items()}
    return marks


def _pixel(value: object, name: str, end: str, path: Path) -> tuple[float, float]:
    if isinstance(value, list) and len(value) == 2:
        numbers = [x for x in value if isinstance(x, int | float) and not isinstance(x, bool)]
        if len(numbers) == 2 and np.isfinite(numbers).all():
            return float(numbers[0]), float(numbers[1])
    raise UserError(
        f"[{name}.{end}] in {path} contains {excerpt(value)}; replace it by a pixel such as"
        " [812, 440]"
    )


def measure(scene: Scene, marks: Marks, name: str, true: float) -> LengthMeasurement:
    """Measure a marked length at the scene's present scale.

    Args:
        scene: Scene aligned to the world frame.
        marks: Result of `read_marks`.
        name: Which length.
        true: The known length, m.

    Raises:
        UserError: There are no such marks, they name an image that the scene lacks, or their rays
            do not determine a length.
    """
    if name not in marks:
        listed = ", ".join(marks) or "none"
        raise UserError(f"the marks contain no {name!r}; they contain: {listed}")
    ends, errors = [], []
    for end in ("from", "to"):
        position, error = _triangulate(scene, marks[name][end], f"{name}.{end}")
        ends.append(position)
        errors.append(error)
    measured = float(np.linalg.norm(ends[1] - ends[0]))
    if not measured > 0:
        raise UserError(f"both ends of {name!r} have the same position; mark them again")
    error = float(np.hypot(*errors)) / measured
    return LengthMeasurement(name, true, measured, max(error, MIN_ERROR))


def _triangulate(
    scene: Scene, pixels: Mapping[str, tuple[float, float]], where: str
) -> tuple[Float[np.ndarray, "3"], float]:
    """Return the point closest to the rays through a mark, world frame, and its error, m.

    Args:
        scene: Scene aligned to the world frame.
        pixels: The mark's pixel by image name.
        where: Name of the mark, for messages.
    """
    by_name = {view.name: view for view in scene.views}
    origins, directions, focal_lengths = [], [], []
    for image, pixel in pixels.items():
        if image not in by_name:
            raise UserError(
                f"[{where}] names the image {image}, which the scene lacks; use names such as"
                f" {scene.views[0].name}"
            )
        view = by_name[image]
        camera, c2w = scene.cameras[view.camera], scene.c2w_world(view)
        if not (0 <= pixel[0] <= camera.width and 0 <= pixel[1] <= camera.height):
            raise UserError(
                f"[{where}] lies outside {image}, which has {camera.width}x{camera.height} pixels;"
                " mark it again"
            )
        origins.append(c2w[:3, 3])
        focal_lengths.append(camera.fx)
        directions.append(camera.directions(np.array(pixel)) @ c2w[:3, :3].T)
    o, d = np.array(origins), np.array(directions)
    angle = np.degrees(np.arccos(np.clip((d @ d.T).min(), -1, 1)))
    if angle < MIN_ANGLE:
        raise UserError(
            f"[{where}] is marked in images from nearly one position ({angle:.1f} degrees apart);"
            " mark it in images taken further apart"
        )
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    information = across.sum(0)
    point = np.linalg.solve(information, np.einsum("nij,nj->i", across, o))
    residual = np.einsum("nij,nj->ni", across, point - o)
    if (((point - o) * d).sum(-1) <= 0).any():
        raise UserError(f"the rays through [{where}] meet behind a camera; mark it again")
    # n rays have 2 n coordinates across and the point has 3. The residuals of a few rays may be
    # small by chance, so the variance is at least that of the marks.
    variance = (residual**2).sum() / max(2 * len(o) - 3, 1)
    click = CLICK_SIGMA / np.array(focal_lengths) * np.linalg.norm(point - o, axis=-1)
    variance = max(variance, float((click**2).mean()))
    return point, float(np.sqrt(variance * np.trace(np.linalg.inv(information)) / 3))


def apply_known_lengths(scene: Scene, lengths: list[LengthMeasurement]) -> Scene:
    """Return the scene scaled by known lengths, about its ground datum.

    Several lengths are averaged with weights 1 / error^2; a disagreement gives a warning.
    """
    ratio = np.array([m.true / m.measured for m in lengths])
    error = np.array([m.error for m in lengths])
    weight = 1 / error**2
    factor = float((ratio * weight).sum() / weight.sum())
    spread = float(np.abs(ratio / factor - 1).max())
    combined = max(float(1 / np.sqrt(weight.sum())), spread)
    out = rescaled(scene, factor, "known-length", combined)
    for m, r in zip(lengths, ratio, strict=True):
        if len(lengths) > 1:
            out = with_scale_evidence(out, m.name, float(r) / factor, m.error)
    if spread > DISAGREEMENT:
        listed = ", ".join(f"{m.name} x{r:.2f}" for m, r in zip(lengths, ratio, strict=True))
        message = f"The known lengths disagree ({listed})"
        finding = Finding("scale-disagrees", message, "check their marks", file=str(scene.root))
        out = replace(out, findings=(*out.findings, finding))
    return out

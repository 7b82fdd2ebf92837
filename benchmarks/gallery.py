"""Make the contact sheets of docs/gallery from fitted runs.

python benchmarks/gallery.py street RUN
python benchmarks/gallery.py ditch RUN --level "-1.5 m" --visibility "60 m" --snow "15 cm"

python benchmarks/gallery.py ditch RUN --surfaces
python benchmarks/gallery.py street-busy RUN --passers-by
python benchmarks/gallery.py ditch RUN --ground --level=-1.5m --columns 2
python benchmarks/gallery.py street-hard RUN --before EARLIER --columns 2
python benchmarks/gallery.py street-sun RUN --light --columns 3
python benchmarks/gallery.py street-sun RUN --depths --columns 2
python benchmarks/gallery.py ditch RUN --water="-1.5 m,-1 m,-0.5 m" --columns 2
python benchmarks/gallery.py ditch RUN --seasons --level="-1 m" --columns 2

Each sheet is a JPEG of at most 150 KB, marked as simulated. NAME.jpg has the rows clean, flood,
smog, snow and all at once, and columns along the camera path. With --surfaces, NAME-surfaces.jpg
shows colours, depth, normals and classes of held-out views. With --passers-by, NAME-passers-by.jpg
shows the most masked photos, the mask in red, and the field from the same cameras. With --ground,
NAME-ground.jpg shows photos' cameras turned down by 15 degrees, clean and flooded, without and with
completed ground. With --before, NAME-before-after.jpg shows each weather in an earlier run and in
this one; levels count from the datum of each. With --light, NAME-light.jpg shows the place in the
light of the photos, under other skies, in fog and under snow. With --depths, NAME-snow.jpg shows
2, 10 and 30 cm of snow in the light of the photos and under an overcast sky. With --water,
NAME-water.jpg shows rising muddy water, then clear water at the highest of the levels. With
--seasons, NAME-seasons.jpg shows the place in each season, flooded in autumn and snowy in winter.
"""

import argparse
import tempfile
from pathlib import Path

import common
import numpy as np
import torch
from PIL import Image

import climatenerf
from climatenerf.core.storage import read_safetensors
from climatenerf.field.checkpoint import load_field
from climatenerf.output.contact_sheet import contact_sheet, write_jpeg
from climatenerf.render.frame import FrameOptions, render_frame
from climatenerf.render.session import RenderSession
from climatenerf.scene import load_scene
from climatenerf.scene.images import load_image
from climatenerf.studies.geometry_ablation import depth_picture, normal_picture
from climatenerf.training.folder import OPTIMISER
from climatenerf.training.transients import MASK_THRESHOLD, TransientMasks
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.season.palettes import SEASONS
from climatenerf.weather.units import LENGTH, parse_quantity
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import World

# Cityscapes' colours of road, building, vegetation, terrain, sky, person and vehicle.
PAINT = np.zeros((256, 3), np.uint8)
PAINT[:7] = [[128, 64, 128], [70, 70, 70], [107, 142, 35], [152, 251, 152], [70, 130, 180],
             [220, 20, 60], [0, 0, 142]]  # fmt: skip
TURN = -np.radians(15.0)  # of a camera about its x axis, downwards
CLEAR = "6 m"  # Secchi depth of a clear lake
GALLERY = Path(__file__).resolve().parents[1] / "docs" / "gallery"


Rows = list[tuple[str, list[np.ndarray]]]


def weathers(run: Path, options: argparse.Namespace) -> Rows:
    """Render frames along the path in each weather."""
    flood = ["--flood.level", options.level]
    smog = ["--smog.visibility", options.visibility]
    snow = ["--snow.depth", options.snow]
    flags = {"clean": [], "flood": flood, "smog": smog, "snow": snow}
    flags["all"] = [*flood, *smog, *snow]
    return along_path(run, options, flags)


def light(run: Path, options: argparse.Namespace) -> Rows:
    """Render frames along the path under other skies."""
    overcast = ["--sky.kind", "overcast"]
    low_sun = ["--sun.elevation", "12 deg", "--sun.azimuth", options.azimuth]
    flags = {
        "captured": [],
        "overcast": overcast,
        "low sun": ["--sky.kind", "clear", *low_sun],
        "dusk": ["--sky.kind", "dusk"],
        "fog": ["--smog.kind", "fog", "--smog.visibility", options.visibility],
        "snow, overcast": ["--snow.depth", options.snow, *overcast],
    }
    return along_path(run, options, flags)


def depths(run: Path, options: argparse.Namespace) -> Rows:
    """Render frames along the path under more and more snow."""
    flags = {}
    for depth in ("2 cm", "10 cm", "30 cm"):
        flags[depth] = ["--snow.depth", depth]
        flags[f"{depth}, overcast"] = ["--snow.depth", depth, "--sky.kind", "overcast"]
    return along_path(run, options, flags)


def water(run: Path, options: argparse.Namespace) -> Rows:
    """Render frames along the path as muddy water rises, then with clear water."""
    levels = [level.strip() for level in options.water.split(",")]
    flags = {level: [f"--flood.level={level}"] for level in levels}
    flags["clear"] = [f"--flood.level={levels[-1]}", "--flood.clarity", CLEAR]
    return along_path(run, options, flags)


def seasons(run: Path, options: argparse.Namespace) -> Rows:
    """Render frames along the path in each season, and two of them in weather."""
    flags = {season: ["--season.kind", season] for season in ("captured", *SEASONS)}
    flags["autumn, flood"] = [*flags["autumn"], f"--flood.level={options.level}"]
    flags["winter, snow"] = [*flags["winter"], "--snow.depth", options.snow]
    return along_path(run, options, flags)


def along_path(run: Path, options: argparse.Namespace, flags: dict[str, list[str]]) -> Rows:
    """Render frames along the path with the command line, for each set of flags."""
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        for label, args in flags.items():
            out = Path(temporary) / label
            base = ["render", str(run), "-o", str(out), "--path", options.path]
            base += ["--frames", str(options.columns), "--size", options.size]
            common.command(*base, "--supersample", str(options.supersample), *args)
            frames = sorted((out / "frames").glob("*.png"))
            rows.append((label, [np.asarray(Image.open(path)) for path in frames]))
    return rows


def before_after(earlier: Path, run: Path, options: argparse.Namespace) -> Rows:
    """Render the same frames of two runs of a capture in each weather, row below row."""
    rows: Rows = []
    for before, after in zip(weathers(earlier, options), weathers(run, options), strict=True):
        rows += [(f"{before[0]}, before", before[1]), (f"{after[0]}, after", after[1])]
    return rows


def surfaces(run: Path, columns: int) -> Rows:
    """Render colours, inverse depth, normals and classes of held-out views."""
    field, scene = load_field(run), load_scene(run)
    views = scene.of_split("heldout") or scene.of_split("train")
    chosen = np.unique(np.linspace(0, len(views) - 1, columns).round().astype(int))
    rows: Rows = [("photo", []), ("field", []), ("depth", []), ("normals", []), ("classes", [])]
    for view in (views[i] for i in chosen):
        camera = scene.cameras[view.camera]
        small = camera.resized(320, round(camera.height * 320 / camera.width))
        world = World(field)
        options = FrameOptions(supersample=2, normals=True, labels=True)
        picture, layers = render_frame(world, small, scene.c2w_world(view), options)
        photo = Image.fromarray(load_image(view, scene)).resize((small.width, small.height))
        pictures = [np.asarray(photo), picture, depth_picture(layers["depth"])]
        pictures += [normal_picture(layers["normal"])]
        pictures += [PAINT[layers["label"].astype(np.uint8)]] if "label" in layers else []
        for row, each in zip(rows, pictures, strict=False):
            row[1].append(each)
    return [row for row in rows if row[1]]


def passers_by(run: Path, columns: int) -> Rows:
    """Show some of the twelve most masked photos, their masks, and renders in their appearance."""
    field, scene = load_field(run), load_scene(run)
    views, state = scene.of_split("train"), read_safetensors(run / OPTIMISER)[0]
    masks = TransientMasks(len(views))
    weights = {key.removeprefix("masks."): value for key, value in state.items() if "masks." in key}
    masks.load_state_dict({key: torch.as_tensor(value) for key, value in weights.items()})
    most_masked = np.argsort(-masks.masked_fractions().numpy())[:12]
    rows: Rows = [("photo", []), ("masked", []), ("field", [])]
    for i in np.sort(most_masked)[:: max(1, 12 // columns)][:columns]:
        view, photo = views[i], load_image(views[i], scene)
        y, x = ((np.arange(side) + 0.5) / side for side in photo.shape[:2])
        position = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float32)
        with torch.no_grad():
            mask = (
                masks(torch.full((len(position),), int(i)), torch.from_numpy(position))
                > MASK_THRESHOLD
            )
        marked = photo.copy()
        marked[mask.view(photo.shape[:2]).numpy()] = (220, 20, 60)
        world = World(field, appearance=field.embeddings[[int(i)]].detach())
        picture, _ = render_frame(world, scene.cameras[view.camera], scene.c2w_world(view))
        for row, each in zip(rows, (photo, marked, picture), strict=True):
            row[1].append(each)
    return rows


def ground(run_folder: Path, options: argparse.Namespace) -> Rows:
    """Look down from training photos, clean and flooded, without and with completed ground."""
    run = climatenerf.load_run(run_folder)
    views = run.scene.of_split("train")
    chosen = np.linspace(0, len(views) - 1, options.columns + 2).round().astype(int)[1:-1]
    level = parse_quantity(options.level, LENGTH)
    weathers = {"clean": Weather(), "flood": Weather(flood=Flood(level=level))}
    fields = {"as fitted": run.field, "completed": run.completed()}
    cosine, sine = np.cos(TURN), np.sin(TURN)
    down = np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    rows: Rows = []
    for label, weather in weathers.items():
        for kind, field in fields.items():
            pictures = []
            for view in (views[i] for i in chosen):
                c2w = run.scene.c2w_world(view).copy()
                c2w[:3, :3] = c2w[:3, :3] @ down
                camera = run.scene.cameras[view.camera]
                session = RenderSession(field, run.scene, weather, c2w[None, :3, 3])
                pictures.append(session.frame(camera, c2w).picture)
            rows.append((f"{label}, {kind}", pictures))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name")
    parser.add_argument("run", type=Path)
    parser.add_argument("--level", default="0.5 m")
    parser.add_argument("--visibility", default="40 m")
    parser.add_argument("--snow", default="15 cm")
    parser.add_argument("--azimuth", default="60 deg", help="of the low sun")
    parser.add_argument("--size", default="384x216")
    parser.add_argument("--path", default="training")
    parser.add_argument("--columns", type=int, default=4)
    parser.add_argument("--supersample", type=int, default=2)
    parser.add_argument("--out", type=Path, default=GALLERY)
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument("--surfaces", action="store_true")
    kinds.add_argument("--passers-by", action="store_true")
    kinds.add_argument("--ground", action="store_true")
    kinds.add_argument("--light", action="store_true")
    kinds.add_argument("--depths", action="store_true")
    kinds.add_argument("--water", metavar="LEVELS", help="such as '20 cm,50 cm'")
    kinds.add_argument("--seasons", action="store_true")
    kinds.add_argument("--before", type=Path, metavar="RUN", help="an earlier run")
    options = parser.parse_args()
    name = options.name
    if options.surfaces:
        name, rows = f"{name}-surfaces", surfaces(options.run, options.columns)
    elif options.passers_by:
        name, rows = f"{name}-passers-by", passers_by(options.run, options.columns)
    elif options.ground:
        name, rows = f"{name}-ground", ground(options.run, options)
    elif options.light:
        name, rows = f"{name}-light", light(options.run, options)
    elif options.depths:
        name, rows = f"{name}-snow", depths(options.run, options)
    elif options.water:
        name, rows = f"{name}-water", water(options.run, options)
    elif options.seasons:
        name, rows = f"{name}-seasons", seasons(options.run, options)
    elif options.before:
        name += "-before-after"
        rows = before_after(options.before, options.run, options)
    else:
        rows = weathers(options.run, options)
    wide = ("ground", "before", "light", "depths", "water", "seasons")
    width = 480 if any(vars(options)[kind] for kind in wide) else 320
    sheet = contact_sheet(rows, options.columns, cell_width=width)
    path = options.out / f"{name}.jpg"
    size = write_jpeg(path, sheet, max_bytes=150_000)
    common.report("contact sheet", {"file": path.name, "bytes": size})


if __name__ == "__main__":
    main()

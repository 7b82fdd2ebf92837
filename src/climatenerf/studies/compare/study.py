"""The comparison: render, edit, score, write. Every finished frame is kept for the next run."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from climatenerf.core.errors import UserError
from climatenerf.core.locks import LOCK, only_writer
from climatenerf.core.storage import is_temporary, write_json
from climatenerf.field.protocol import RadianceField
from climatenerf.output import job as jobs
from climatenerf.output.frame_source import FrameSource, frame_source
from climatenerf.paths.camera_path import CameraPath
from climatenerf.scene import Scene
from climatenerf.studies.compare import report
from climatenerf.studies.compare.cases import TrueViews
from climatenerf.studies.compare.material import MASKS, TRUTH, Material, Method, Rendered
from climatenerf.studies.compare.pictures import Picture
from climatenerf.studies.compare.scores import movie_scores, truth_scores
from climatenerf.studies.compare.stand_ins import STAND_INS
from climatenerf.studies.compare.store import FrameStore, make_frames, store_of
from climatenerf.studies.compare.uvq import Uvq
from climatenerf.studies.user_study.compare_folder import SCHEMA_VERSION
from climatenerf.weather.description import KeyframedWeather
from climatenerf.weather.style import Style
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import Kept

OURS = "climatenerf"
MARKER = ".compare.json"
"""File that says that a folder is a comparison's, from its beginning on."""
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Fitted:
    """A fitted run.

    Attributes:
        folder: the run folder.
        scene: its capture.
        digest: hash of the run's files; None takes that of the files as they are.
        knows_classes: whether its field has classes.
        completed: gives the field with completed ground; called once, if a frame is missing.
        style: new colours of the run; None: those of the photos.
    """

    folder: Path
    scene: Scene
    digest: str | None
    knows_classes: bool
    completed: Callable[[Progress], RadianceField]
    style: Style | None = None


@dataclass(frozen=True)
class Plan:
    """What is compared.

    Attributes:
        path: camera of each frame.
        fps: frames per second.
        weathers: weather by effect.
        seed: random seed of the methods.
        methods: besides the stand-ins.
        truth: test views with true pictures, or None.
        uvq: scores movies, or None.
        licence: licence or source of the capture, or None.
    """

    path: CameraPath
    fps: float
    weathers: Mapping[str, KeyframedWeather]
    seed: int
    methods: tuple[Method, ...] = ()
    truth: TrueViews | None = None
    uvq: Uvq | None = None
    licence: str | None = None


def check_methods(methods: tuple[Method, ...]) -> None:
    """Refuse two methods of one name.

    Raises:
        UserError: there are.
    """
    names = [OURS, *(method.name for method in (*STAND_INS, *methods))]
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"two methods are named {name}; give one another name, as NAME=FOLDER")


def check_folder(out: Path) -> None:
    """Refuse a folder that is neither empty nor a comparison's.

    Raises:
        UserError: it holds other files.
    """
    if not out.is_dir() or (out / MARKER).is_file():
        return
    # Another process that begins a comparison has its lock and a temporary file there.
    if any(path.name != LOCK and not is_temporary(path.name) for path in out.iterdir()):
        raise UserError(f"{out} holds files that no comparison made; choose another folder with -o")


def compare(
    fitted: Fitted, out: Path, plan: Plan, progress: Progress, note: Callable[[str], None]
) -> dict[str, Any]:
    """Make the comparison in a folder; return the content of its `compare.json`.

    Frames that an earlier call finished with the same settings are kept.

    Args:
        fitted: the run.
        out: the folder.
        plan: what is compared.
        progress: called with what is done and the fraction of it that is finished.
        note: called with sentences about what was assumed or left out.

    Raises:
        UserError: the folder holds other files or is in use, a method fails, or a disk error.
    """
    check_methods(plan.methods)
    check_folder(out)
    with only_writer(out):
        check_folder(out)
        write_json(out / MARKER, {"schema_version": SCHEMA_VERSION})
        return _Comparison(fitted, out, plan, progress, note).run()


class _Comparison:
    """The steps of `compare`."""

    def __init__(
        self,
        fitted: Fitted,
        out: Path,
        plan: Plan,
        progress: Progress,
        note: Callable[[str], None],
    ) -> None:
        self.fitted, self.out, self.plan = fitted, out, plan
        self.progress, self.note = progress, note
        self.field: RadianceField | None = None

    def run(self) -> dict[str, Any]:
        """Render, edit and score everything, and write the report."""
        made: dict[str, list[report.Made]] = {effect: [] for effect in self.plan.weathers}
        clean = self.rendered("", "clean", self.plan.path, None)
        for effect, weather in self.plan.weathers.items():
            ours = self.rendered("", f"{effect}/{OURS}", self.plan.path, (effect, weather))
            material = self.material(effect, "", clean, ours, ())
            made[effect] = self.methods_of(material)
        if self.plan.truth is not None:
            self.score_truth(self.plan.truth, made)
        self.progress("report", 0.0)
        data = report.write(self.out, self.fitted.scene, self.plan, clean, made)
        self.progress("report", 1.0)
        return data

    def rendered(
        self,
        reel: str,
        name: str,
        path: CameraPath,
        weather: tuple[str, KeyframedWeather] | None,
    ) -> Rendered:
        """Render the frames of a reel that are missing.

        Args:
            reel: as `Material.reel`.
            name: folder within the reel.
            path: the cameras.
            weather: effect and its weather; None for clean frames.
        """
        layers = ("depth", "normal", *(("label",) if self.fitted.knows_classes else ()))
        film = KeyframedWeather(Weather(), {})
        if weather is not None:
            effect, film = weather
            layers = ("depth", MASKS[effect])
        fitted = self.fitted
        given = fitted.folder, path, self.plan.fps, film
        job = jobs.plan(*given, layers=layers, digest=fitted.digest, style=fitted.style)
        folder = self.out / reel / name
        times = FrameStore(folder, job.key, len(job))

        def report_progress(what: str, fraction: float) -> None:
            self.progress(f"{Path(reel, name)}, {what}", fraction)

        def prepare() -> FrameSource:
            if self.field is None:
                self.field = self.fitted.completed(report_progress)
            source = frame_source(
                job,
                self.field,
                self.fitted.scene,
                report_progress,
                Kept(self.fitted.folder, job.run),
            )
            return times.timed(source)

        note = self.note if name == "clean" and not reel else None
        jobs.render_movie(
            job, self.fitted.scene, folder, prepare, note=note, progress=report_progress
        )
        return Rendered(job, folder)

    def material(
        self, effect: str, reel: str, clean: Rendered, ours: Rendered, true: tuple[Picture, ...]
    ) -> Material:
        """Return the material of one effect."""
        ground_z = self.fitted.scene.ground_z
        return Material(effect, reel, clean, ours, ground_z, self.plan.seed, true)

    def methods_of(self, material: Material) -> list[report.Made]:
        """Let every method edit the movie, and score it; ours comes first."""
        ours = FrameStore(material.ours.folder, material.ours.job.key, len(material))
        scores = asdict(movie_scores(material, material.ours.picture, own_depth=True))
        scores["seconds"] = ours.mean_seconds()
        found = [report.Made(OURS, "ours", report.OUR_LICENCE, ours.folder, material, scores)]
        for method in (*STAND_INS, *self.plan.methods):
            if not method.shows(material):
                continue
            store = self.edited(method, material)
            scores = asdict(movie_scores(material, store.picture, own_depth=False))
            scores["seconds"] = store.mean_seconds()
            found.append(
                report.Made(
                    method.name, method.kind, method.licence, store.folder, material, scores
                )
            )
        if self.plan.uvq is not None:
            for each in found:
                self.progress(f"UVQ, {material.effect}, {each.name}", 0.0)
                each.scores["uvq"] = self.plan.uvq.score(each.folder / "movie.mp4", each.folder)
        return found

    def edited(self, method: Method, material: Material) -> FrameStore:
        """Let a method edit the frames that are missing, and write its movie."""
        place = Path(material.reel, material.effect, method.name)
        store = store_of(method, material, self.out / place)
        make_frames(method, material, store, lambda done: self.progress(str(place), done))
        if not material.reel:
            store.write_movie(material.size, self.plan.fps)
        return store

    def score_truth(self, truth: TrueViews, made: dict[str, list[report.Made]]) -> None:
        """Add the scores against true pictures."""
        clean = self.rendered(TRUTH, "clean", truth.path, None)
        for effect, weather in truth.weathers.items():
            ours = self.rendered(TRUTH, f"{effect}/{OURS}", truth.path, (effect, weather))
            material = self.material(effect, TRUTH, clean, ours, truth.pictures[effect])
            methods = {method.name: method for method in (*STAND_INS, *self.plan.methods)}
            for each in made[effect]:
                if each.name == OURS:
                    each.scores.update(truth_scores(material, ours.picture))
                elif methods[each.name].shows(material):
                    store = self.edited(methods[each.name], material)
                    each.scores.update(truth_scores(material, store.picture))

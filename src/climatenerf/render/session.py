"""A render session: weather prepared once in a scene, then asked for frames at any moment.

Every effect is prepared from the parameters that it names in `Effect.prepared_from`. A changed
parameter prepares only the effects that name it; all others are placed anew at the next frame.
"""

import copy
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.cameras import Camera
from climatenerf.field.capabilities import CLASSES, NORMALS
from climatenerf.field.protocol import RadianceField, observed, require
from climatenerf.render.frame import FrameOptions, Picture, encoded_8bit, see_frame
from climatenerf.render.irradiance import scene_irradiance
from climatenerf.render.photo_rays import trace_photos
from climatenerf.scene.photo_rays import PhotoRays
from climatenerf.scene.scene import Scene
from climatenerf.weather.description import KeyframedWeather, for_effects
from climatenerf.weather.effect import Effect, Entity
from climatenerf.weather.registry import check_effects, in_order, installed_effects, layer_table
from climatenerf.weather.style import Style
from climatenerf.weather.weather import Weather, check
from climatenerf.weather.world import Kept, Preparation, World, unreported

Key = tuple[tuple[object, ...], ...]


@dataclass(frozen=True)
class Frame:
    """One rendered frame.

    Attributes:
        linear: linear radiance.
        layers: measured layers by name, float32 (label: uint8).
    """

    linear: Float[Tensor, "h w 3"]
    layers: dict[str, Float[np.ndarray, "h w *c"]]

    @functools.cached_property
    def picture(self) -> Picture:
        """The frame in 8-bit display sRGB."""
        return encoded_8bit(self.linear)


@dataclass
class _Found:
    """What a session finds once, shared with the sessions that are made from it.

    Attributes:
        photos: rays of the photos with what they meet; None: not asked for yet.
        light: irradiance of the photos on open level ground; None: not asked for yet.
    """

    photos: list[PhotoRays] | None = None
    light: Float[Tensor, "3"] | None = None


class RenderSession:
    """A field under weather that may change over time."""

    def __init__(
        self,
        field: RadianceField,
        scene: Scene,
        weather: KeyframedWeather | Weather,
        camera_positions: Float[np.ndarray, "m 3"] | None = None,
        times: Float[np.ndarray, "f"] | None = None,
        appearance: Float[Tensor, "1 e"] | None = None,
        progress: Callable[[str, float], None] | None = None,
        effects: Sequence[Effect] | None = None,
        kept: Kept | None = None,
        style: Style | None = None,
    ):
        """Prepare everything that is computed once: light, waves, snowfall.

        Args:
            field: the fitted field, or any other.
            scene: its capture.
            weather: what to put in, keyframed or not.
            camera_positions: of the frames, world m; snow is finest around them. Default: those of
                the training photos.
            times: moments of the frames, s. Default: 0 s alone.
            appearance: exposure and light of the field's colours; None: the mean of all photos.
            progress: called with what is being done and the fraction that is done, [0, 1].
            effects: the effects to render with; None takes the installed ones. A section of the
                weather that has values of its own needs its effect among them.
            kept: the run folder, where what is found in the field is kept; None: nowhere.
            style: new colours of the scene, see `climatenerf stylize`; None: those of the photos.

        Raises:
            UserError: a value out of its range, a level above the whole scene, effects that clash,
                a section of the weather without its effect, or a field that lacks what an effect
                needs.
        """
        if camera_positions is None:
            views = scene.of_split("train")
            camera_positions = np.stack([scene.c2w_world(view)[:3, 3] for view in views])
        self.field = field
        self.scene = scene
        used = installed_effects() if effects is None else check_effects(tuple(effects))
        self.effects = in_order(used)
        self._camera_positions = camera_positions
        self._times = np.zeros(1) if times is None else times
        self._appearance = appearance
        self._progress = progress or unreported
        self._kept = kept
        self._style = style
        self._found = _Found()
        self._keys: dict[str, Key] = {}
        self._entities: dict[str, Entity] = {}
        self.change(weather)

    def change(self, weather: KeyframedWeather | Weather) -> tuple[str, ...]:
        """Put other weather in; prepares what the changed parameters invalidate.

        Returns:
            Names of the effects that were prepared.

        Raises:
            UserError: as the constructor; the session then keeps its weather.
        """
        weather = for_effects(weather, self.effects)
        moments = [check(weather.at(float(t)), self.effects) for t in self._times]
        prepared = {}
        for effect in self.effects:
            own = tuple(
                m for m in moments if effect.always or effect.present(m.sections[effect.name])
            )
            function = effect.load() if own else None
            if function is None:
                continue
            require(self.field, effect.needs, f"the weather effect {effect.name!r}")
            key = _key(effect, own)
            if self._keys.get(effect.name) == key:
                entity = self._entities[effect.name]
            else:
                entity = function(self._preparation(own))
                prepared[effect.name] = key, entity
            entity.check(own)
        # Not in place, since a copy may be rendered meanwhile.
        self._keys = self._keys | {name: key for name, (key, _) in prepared.items()}
        self._entities = self._entities | {name: made for name, (_, made) in prepared.items()}
        self.weather = weather
        return tuple(prepared)

    def changed(
        self,
        weather: KeyframedWeather | Weather,
        times: Float[np.ndarray, "f"] | None = None,
        progress: Callable[[str, float], None] | None = None,
    ) -> "RenderSession":
        """Return a session with other weather, while this one can be rendered meanwhile.

        Both share what the changed parameters leave valid.

        Args:
            weather: what to put in.
            times: moments of the frames, s; None: those of this session.
            progress: see the constructor; None: that of this session. It may raise, which ends the
                preparation.

        Raises:
            UserError: as the constructor.
        """
        other = copy.copy(self)
        other._times = self._times if times is None else times
        other._progress = progress or self._progress
        other.change(weather)
        return other

    def __getstate__(self) -> dict[str, object]:
        """Leave the receiver of progress out of a pickle: it belongs to one process."""
        return {**self.__dict__, "_progress": unreported}

    @property
    def facts(self) -> dict[str, float]:
        """Numbers about the prepared effects, for the sidecar."""
        return {
            name: value
            for effect in self.effects
            if effect.name in self._entities
            for name, value in self._entities[effect.name].facts().items()
        }

    def world(self, time: float) -> World:
        """Everything that a ray can meet at a time in s."""
        weather = self.weather.at(time)
        world = World(self.field, self._appearance)
        for effect in self.effects:
            here = effect.always or effect.present(weather.sections[effect.name])
            if here and effect.name in self._entities:
                world = self._entities[effect.name].place(world, weather, time)
        return world

    def frame(
        self,
        camera: Camera,
        c2w: Float[np.ndarray, "4 4"],
        time: float = 0.0,
        shutter: float = 0.0,
        *,
        supersample: int = 1,
        layers: Sequence[str] = (),
        preview: Callable[[Picture], None] | None = None,
        cancelled: Callable[[], bool] | None = None,
    ) -> Frame:
        """Render one frame.

        Args:
            camera: intrinsics.
            c2w: pose, world m.
            time: moment at which the shutter opens, s.
            shutter: seconds that it stays open. Until an effect integrates over it, the frame is
                that of its middle.
            supersample: rays per pixel along each side, 1 to 8.
            layers: names of wanted layers; `normal` and `label` are computed on demand, the others
                always.
            preview: called with the display picture as it becomes finer.
            cancelled: asked every 10 to 20 ms of computing; True ends the render. Its attribute
                `every`, if it has one, is a longer time (s), which costs less.

        Raises:
            RenderCancelled: `cancelled` has answered True.
        """
        options = FrameOptions(
            supersample,
            "normal" in layers,
            "label" in layers,
            layer_table(self.effects),
            preview,
            cancelled,
        )
        return Frame(*see_frame(self.world(time + shutter / 2), camera, c2w, options))

    def _preparation(self, moments: tuple[Weather, ...]) -> Preparation:
        return Preparation(
            self.field,
            self.scene,
            moments,
            self._camera_positions,
            self._appearance,
            self._irradiance,
            self._progress,
            self._photo_rays if self.field.capabilities & {NORMALS, CLASSES} else None,
            self._kept,
            self._style,
        )

    def _photo_rays(self) -> list[PhotoRays]:
        def report(fraction: float) -> None:
            self._progress("photos", fraction)

        if self._found.photos is None:
            self._found.photos = trace_photos(observed(self.field), self.scene, report)
        return self._found.photos

    def _irradiance(self) -> Float[Tensor, "3"]:
        if self._found.light is None:
            self._progress("light", 0.0)
            self._found.light = self._open_irradiance()
        return self._found.light

    def _open_irradiance(self) -> Float[Tensor, "3"]:
        """Irradiance of the photos on open level ground.

        Ground that a style has recoloured would tell another; the style then has that of before, in
        the mean of all photos.
        """
        shown = scene_irradiance(self.field, self.scene, self._appearance)
        style = self._style
        if style is None or style.fine_tuned is None:
            return shown
        before = shown.new_tensor(style.fine_tuned.irradiance)
        if self._appearance is None:
            return before
        mean = scene_irradiance(self.field, self.scene, None)
        return before * shown / mean.clamp_min(1e-6)  # a black scene: 0/0


def _key(effect: Effect, moments: Sequence[Weather]) -> Key:
    """The values that an effect is prepared from, without repetitions."""
    values = (tuple(m.value(name) for name in effect.prepared_from) for m in moments)
    return tuple(dict.fromkeys(values))

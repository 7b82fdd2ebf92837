"""Weather as controls: a folder for each effect, a slider, list or text for each parameter."""

import math
import shlex
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from climatenerf.core.errors import UserError
from climatenerf.weather.effect import Effect
from climatenerf.weather.units import Choice, Folder, Parameter
from climatenerf.weather.weather import Weather, check

FPS = 24.0  # of movies
MIN_STEPS = 100  # of a slider
MAIN = {
    "flood": ("level", "wind_speed", "clarity"),
    "snow": ("depth",),
    "smog": ("visibility", "kind"),
    "sky": ("kind",),
    "sun": ("elevation", "azimuth"),
    "season": ("kind", "strength"),
}
"""Parameters that are in sight at first, by effect, in the order of the folders; others follow."""
RANGES = {
    "smog.visibility": (10.0, 500.0),
    "snow.depth": (0.0, 0.6),
    "flood.wind_speed": (0.0, 15.0),
    "flood.clarity": (0.05, 5.0),
    "flood.fetch": (10.0, 1000.0),
}
"""Ranges of sliders where the parameter's own is much larger, SI."""
MAX_RANGE = 1000.0  # parameters with a larger range have a text alone


def slider_range(
    name: str, parameter: Parameter, levels: tuple[float, float]
) -> tuple[float, float] | None:
    """Return the range of a parameter's slider, SI; None: it has a text alone.

    Args:
        name: such as "flood.level".
        parameter: its unit and range.
        levels: water levels that the scene can show, m above the ground datum.
    """
    if isinstance(parameter, Choice | Folder) or parameter.count > 1:
        return None
    if name == "flood.level":
        return levels
    if name in RANGES:
        return RANGES[name]
    low, high = parameter.low, parameter.high
    wide = not math.isfinite(low) or not math.isfinite(high) or high - low > MAX_RANGE
    return None if wide else (low, high)


def render_command(
    run: Path,
    weather: Weather | Path,
    effects: Sequence[Effect],
    path: str,
    size: tuple[int, int],
    seconds: float = 0.0,
) -> str:
    """Return the line that renders what the viewer shows.

    Args:
        run: the run folder.
        weather: what is put in, or the weather file that holds it.
        effects: those that may differ from their defaults.
        path: value of --path.
        size: of the picture, pixels.
        seconds: length of a movie that stands still; 0: that of the path.
    """
    words = ["climatenerf", "render", str(run), "-o", "out", "--path", path]
    words += ["--size", f"{size[0]}x{size[1]}"]
    if seconds > 0:
        words += ["--frames", str(round(seconds * FPS) + 1), "--fps", f"{FPS:g}"]
    if isinstance(weather, Path):
        return shlex.join([*words, "--weather", str(weather)])
    for effect in effects:
        for item, parameter in effect.fields().items():
            value = weather.value(f"{effect.name}.{item}")
            if value == effect.defaults()[item]:
                continue
            flag = f"--{effect.name}.{item}".replace("_", "-")
            written = parameter.write(value)
            given = [str(x) for x in written] if isinstance(written, list) else [str(written)]
            # One word, since a value that begins with "-" would be taken for a flag.
            words += [f"{flag}={given[0]}"] if len(given) == 1 else [flag, *given]
    if weather.seed:
        words += ["--seed", str(weather.seed)]
    return shlex.join(words)


class WeatherControls:
    """Controls of one viewer's weather."""

    def __init__(
        self,
        gui: Any,
        effects: Sequence[Effect],
        weather: Weather,
        levels: tuple[float, float],
        changed: Callable[[Weather], None],
        tell: Callable[[str], None],
    ):
        """Add the controls.

        Args:
            gui: of the viewer, by viser.
            effects: in the order of their folders.
            weather: to begin with.
            levels: water levels that the scene can show, m above the ground datum.
            changed: takes each new weather.
            tell: takes what is wrong with an input; "" clears it.
        """
        self._effects, self._changed, self._tell = tuple(effects), changed, tell
        self.weather = weather
        self._texts: dict[str, Any] = {}
        self._sliders: dict[str, Any] = {}
        self._switches: dict[str, Any] = {}
        self._updating = False
        self._lock = threading.RLock()  # viser runs callbacks on many threads
        order = {name: index for index, name in enumerate(MAIN)}
        for effect in sorted(self._effects, key=lambda each: order.get(each.name, len(order))):
            # Folders of this machine are nothing that a page may name.
            fields = {k: v for k, v in effect.fields().items() if not isinstance(v, Folder)}
            main = [item for item in MAIN.get(effect.name, fields) if item in fields]
            rest = [item for item in fields if item not in main]
            with gui.add_folder(effect.name):
                if effect.enabled_by:
                    self._add_switch(gui, effect)
                for item in main:
                    self._add(gui, f"{effect.name}.{item}", fields[item], levels)
                if rest:
                    with gui.add_folder("more", expand_by_default=False):
                        for item in rest:
                            self._add(gui, f"{effect.name}.{item}", fields[item], levels)
        self._show()

    # --- controls -------------------------------------------------------------------------------

    def _add_switch(self, gui: Any, effect: Effect) -> None:
        switch = gui.add_checkbox("on", effect.present(self.weather.sections[effect.name]))
        self._switches[effect.name] = switch

        def changed() -> None:
            main = f"{effect.name}.{effect.enabled_by[0]}"
            if switch.value:
                if main in self._sliders:
                    self.set(main, self._sliders[main].value)
                else:
                    self._tell(f"give {main} a value")
                    self._show()
            else:
                for item in effect.enabled_by:
                    self.set(f"{effect.name}.{item}", None)

        self._listen(switch, changed)

    def _add(self, gui: Any, name: str, parameter: Parameter, levels: tuple[float, float]) -> None:
        title = name.partition(".")[2].replace("_", " ")
        if isinstance(parameter, Choice):
            self._add_list(gui, name, title, parameter)
        else:
            self._add_number(gui, name, title, parameter, levels)

    def _add_list(self, gui: Any, name: str, title: str, parameter: Choice) -> None:
        value = self.weather.value(name)
        shown = gui.add_dropdown(title, parameter.words, initial_value=value)
        self._texts[name] = shown

        self._listen(shown, lambda: self.set(name, shown.value, shown))

    def _add_number(
        self, gui: Any, name: str, title: str, parameter: Parameter, levels: tuple[float, float]
    ) -> None:
        found = slider_range(name, parameter, levels)
        if found is not None:
            low, high = (value / (parameter.kind.scale if parameter.kind else 1) for value in found)
            value = self.weather.value(name)
            scale = parameter.kind.scale if parameter.kind else 1.0
            middle = (low + high) / 2 if value is None else value / scale
            slider = gui.add_slider(
                f"{title}{f', {parameter.kind.unit}' if parameter.kind else ''}",
                low,
                high,
                _step(high - low),
                min(max(middle, low), high),
            )
            self._sliders[name] = _Scaled(slider, scale)

            self._listen(slider, lambda: self.set(name, slider.value * scale, slider))

        text = gui.add_text("" if found is not None else title, "")
        self._texts[name] = text

        def typed() -> None:
            try:
                self.set(name, parameter.parse(text.value, name.replace("_", "-")), text)
            except UserError as error:
                self._tell(str(error))

        self._listen(text, typed)

    def _listen(self, control: Any, changed: Callable[[], None]) -> None:
        """Call a function when a user changes a control, one at a time."""

        @control.on_update
        def _(_: Any) -> None:
            with self._lock:
                if not self._updating:
                    changed()

    # --- values ---------------------------------------------------------------------------------

    def set(self, name: str, value: Any, source: Any = None) -> None:
        """Change one parameter; an invalid value is refused with a message.

        Args:
            name: such as "flood.level".
            value: SI.
            source: the control that a user has moved or types into, which is left as it is.
        """
        with self._lock:
            weather = self.weather.with_value(name, value)
            effect = next(each for each in self._effects if each.name == name.partition(".")[0])
            for pair in effect.alternatives:  # one replaces the other, as on the command line
                if name.partition(".")[2] in pair and value is not None:
                    other = pair[1 - pair.index(name.partition(".")[2])]
                    default = effect.defaults()[other]
                    weather = weather.with_value(f"{effect.name}.{other}", default)
            try:
                check(weather, self._effects)
            except UserError as error:
                self._tell(str(error))
                return
            if weather == self.weather:
                return
            self.weather = weather
            self._tell("")
            self._show(source)
            self._changed(weather)

    def put(self, weather: Weather) -> None:
        """Show other weather, which is valid, in all controls."""
        with self._lock:
            if weather != self.weather:
                self.weather = weather
                self._show()

    def _show(self, source: Any = None) -> None:
        """Let all controls but one show the weather."""
        with self._lock:
            self._updating = True
            try:
                for effect in self._effects:
                    self._show_effect(effect, source)
            finally:
                self._updating = False

    def _show_effect(self, effect: Effect, source: Any) -> None:
        for item, parameter in effect.fields().items():
            name = f"{effect.name}.{item}"
            text, slider = self._texts.get(name), self._sliders.get(name)
            value = self.weather.value(name)
            shown = value if isinstance(parameter, Choice) else _text(parameter, value)
            if text is not None and text is not source and text.value != shown:
                text.value = shown
            if slider is not None and not slider.moves(source) and value is not None:
                slider.show(value)
        switch = self._switches.get(effect.name)
        present = effect.present(self.weather.sections[effect.name])
        if switch is not None and switch.value != present:
            switch.value = present


def _step(span: float) -> float:
    """Return the largest power of ten that gives a slider enough steps."""
    return 10.0 ** math.floor(math.log10(span / MIN_STEPS))


class _Scaled:
    """A slider in the unit of a parameter, read and set in SI."""

    def __init__(self, slider: Any, scale: float):
        self._slider, self._scale = slider, scale

    @property
    def value(self) -> float:
        return self._slider.value * self._scale

    def moves(self, control: Any) -> bool:
        return control is self._slider

    def show(self, value: float) -> None:
        shown = min(max(value / self._scale, self._slider.min), self._slider.max)
        if abs(self._slider.value - shown) > 1e-9:
            self._slider.value = shown


def _text(parameter: Parameter, value: Any) -> str:
    """Return a value as the text field shows it; `Parameter.parse` reads it."""
    if value is None:
        return "none"
    if isinstance(value, str):
        return value
    if isinstance(value, tuple):
        return " ".join(f"{x:g}" for x in value)
    return parameter.text(value) if parameter.kind is not None else f"{value:g}"

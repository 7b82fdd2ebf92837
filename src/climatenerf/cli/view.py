"""``climatenerf view RUN``: a live view of a fitted place in weather, in the browser."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from climatenerf.cli import progress
from climatenerf.cli.flags import optional
from climatenerf.core.errors import UserError
from climatenerf.weather.description import read_weather
from climatenerf.weather.registry import installed_effects

if TYPE_CHECKING:
    from climatenerf.studies.shot import Place

POLL = 3.0  # s between looks for a newer checkpoint of a fit


@dataclass(frozen=True)
class View:
    """Look at a fitted place in a browser on this machine: move freely, and change the weather by
    sliders. A fit that is still at work is followed. Ctrl-C ends it."""

    run: tyro.conf.Positional[Path]
    """Run folder made by `climatenerf fit`."""
    port: int = 7007
    """Port on the loopback interface; 0 takes a free one."""
    weather: Annotated[Path | None, optional("PATH")] = None
    """Weather file to begin with. If it has keyframes, the time can be moved and played."""
    allow_host: tuple[str, ...] = ()
    """Further host names under which a tunnel presents this machine, such as box.example.org."""
    complete_ground: bool = True
    """Leave holes where no photo shows the ground. By default a smooth terrain completes it."""


def run(options: View) -> int:
    """Serve the place until Ctrl-C.

    Raises:
        UserError: the port is taken, the package is missing, the weather file is wrong, or there is
            no run.
    """
    if not 0 <= options.port < 65536:
        raise UserError("--port must be from 0 to 65535")
    if options.weather is not None:
        read_weather(options.weather, installed_effects())
    from climatenerf.viewer.guarded_server import check_hosts, check_installed, check_port

    check_installed()
    check_hosts(options.allow_host)
    check_port(options.port)
    from climatenerf.training.snapshot import FIELD, identity_of
    from climatenerf.viewer.app import ViewerApp, tunnel_line

    place, digest = _place(options)
    shown = identity_of(options.run / FIELD)
    app = ViewerApp(options.run, place, options.port, options.allow_host, digest, options.weather)
    progress.result(f"viewer: http://localhost:{app.port}")
    progress.say(f"from another machine: {tunnel_line(app.port)}, then the same address there")
    try:
        while True:
            time.sleep(POLL)
            newest = identity_of(options.run / FIELD)
            if newest not in (shown, None):
                app.use(*_place(options))
                shown = newest
    finally:
        app.close()


def _place(options: View) -> "tuple[Place, str | None]":
    """Return the place of a run, and its identity; that of a fit at work has no completed ground.

    Raises:
        UserError: there is no run, or a damaged one.
    """
    from climatenerf.api import load_run
    from climatenerf.studies.shot import Place
    from climatenerf.weather.world import Kept

    fitted = load_run(options.run)
    finished = (options.run / "metrics.json").is_file()
    field = fitted.field
    if options.complete_ground and finished:
        with progress.StageBars() as bars:
            field = fitted.completed(bars)
    kept = Kept(fitted.folder, fitted.digest) if fitted.digest is not None and finished else None
    return Place(field, fitted.scene, kept, fitted.style), fitted.digest

"""``climatenerf view RUN``: a live view of a fitted place in weather, in the browser."""

import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from climatenerf.cli import progress
from climatenerf.core.errors import UserError


@dataclass(frozen=True)
class View:
    """Look at a fitted place in a browser on this machine: move freely, and change the weather by
    sliders. Ctrl-C ends it."""

    run: tyro.conf.Positional[Path]
    """Run folder made by `climatenerf fit`."""
    port: int = 7007
    """Port on the loopback interface; 0 takes a free one."""
    allow_host: tuple[str, ...] = ()
    """Further host names under which a tunnel presents this machine, such as box.example.org."""
    complete_ground: bool = True
    """Leave holes where no photo shows the ground. By default a smooth terrain completes it."""


def run(options: View) -> int:
    """Serve the place until Ctrl-C.

    Raises:
        UserError: the port is taken, the package is missing, or there is no run.
    """
    if not 0 <= options.port < 65536:
        raise UserError("--port must be from 0 to 65535")
    from climatenerf.viewer.guarded_server import check_installed

    check_installed()
    from climatenerf.api import load_run
    from climatenerf.studies.shot import Place
    from climatenerf.viewer.app import ViewerApp, tunnel_line
    from climatenerf.weather.world import Kept

    fitted = load_run(options.run)
    with progress.StageBars() as bars:
        field = fitted.completed(bars) if options.complete_ground else fitted.field
    kept = None if fitted.digest is None else Kept(fitted.folder, fitted.digest)
    place = Place(field, fitted.scene, kept, fitted.style)
    app = ViewerApp(options.run, place, options.port, options.allow_host)
    progress.result(f"viewer: http://localhost:{app.port}")
    progress.say(f"from another machine: {tunnel_line(app.port)}, then the same address there")
    try:
        while True:
            time.sleep(3600)
    finally:
        app.close()

"""A viser server on the loopback interface that answers this machine's own pages alone.

A page of any web site can open a socket to the loopback interface, and viser checks no origin. So
each request is checked before viser sees it: its Host must name this machine, and its Origin, if it
has one, must equal its Host, since the GUI's own page comes from there.
"""

import contextlib
import gzip
import http
import io
import re
import socket
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from climatenerf.core.errors import UserError, one_line

if TYPE_CHECKING:
    import viser

LOOPBACK = "127.0.0.1"
NOTICE = """<script>
if (!document.createElement("canvas").getContext("webgl2")) {
  document.body.insertAdjacentHTML("afterbegin",
    '<p role="alert" style="position:fixed; z-index:9999; margin:1em; padding:1em;' +
    'max-width:30em; background:#fff; color:#111; border:2px solid #b00; font:16px sans-serif">' +
    'This browser has no WebGL 2, which the viewer needs: switch hardware acceleration on or ' +
    'take another browser, or write a page that needs none by <code>climatenerf page</code>.</p>');
}
</script>"""
OWN_NAMES = ("localhost", "127.0.0.1", "::1")


def check_installed() -> None:
    """Refuse to go on without the package.

    Raises:
        UserError: it is not installed.
    """
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise UserError(
            'the viewer needs the package viser; install it by: pip install "climatenerf[view]"'
        ) from error


def is_allowed(host: str | None, origin: str | None, names: Sequence[str]) -> bool:
    """Whether a request comes from a page of this server.

    Args:
        host: header Host.
        origin: header Origin; None without one.
        names: host names that count as this machine.
    """
    try:
        if host is None or (urlsplit(f"//{host}").hostname or "") not in names:
            return False
        return origin is None or urlsplit(origin).netloc == host
    except ValueError:  # neither is a name
        return False


@contextlib.contextmanager
def guarded(names: Sequence[str]) -> Iterator[None]:
    """Let servers that are started inside answer allowed requests alone."""
    import websockets.asyncio.server as websockets_server

    original = websockets_server.serve

    def serve(*args: Any, process_request: Callable | None = None, **options: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
            single = len(hosts) == 1 and len(origins) < 2
            if not single or not is_allowed(hosts[0], origins[0] if origins else None, names):
                return connection.respond(
                    http.HTTPStatus.FORBIDDEN, "This page may be opened on its own machine only.\n"
                )
            response = None if process_request is None else process_request(connection, request)
            if response is not None and "html" in response.headers.get("Content-Type", ""):
                return _with_notice(response)
            return response

        return original(*args, process_request=checked, **options)

    websockets_server.serve = serve  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        websockets_server.serve = original


def _with_notice(response: Any) -> Any:
    """The GUI's own page, which says so where it cannot draw."""
    packed = response.headers.get("Content-Encoding") == "gzip"
    page = gzip.decompress(response.body) if packed else response.body
    body = page.replace(b"</body>", NOTICE.encode() + b"</body>")
    headers = response.headers.copy()
    for name, value in (("Content-Encoding", "identity"), ("Content-Length", str(len(body)))):
        del headers[name]
        headers[name] = value
    return replace(response, headers=headers, body=body)


def check_port(port: int) -> None:
    """Check that a port is free.

    Raises:
        UserError: it is in use or cannot be opened.
    """
    # viser counts a taken port up without a word.
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            raise UserError(
                f"port {port} is in use or cannot be opened; give another --port, or --port 0 for"
                " a free one"
            ) from error


def check_hosts(names: Sequence[str]) -> None:
    """Check names that are given besides the loopback's.

    Raises:
        UserError: one is not the name of a host alone.
    """
    for name in names:
        if not re.fullmatch(r"[A-Za-z0-9._-]+", name):
            raise UserError(
                f'--allow-host must be the name of a host, without port; got "{one_line(name, 60)}"'
            )


def start(port: int, allowed_hosts: Sequence[str] = ()) -> "viser.ViserServer":
    """Start a server on the loopback interface.

    Args:
        port: to listen on; 0 takes a free one.
        allowed_hosts: names besides the loopback's under which a tunnel presents this machine.

    Raises:
        UserError: the package is missing, or the port is taken.
    """
    check_installed()
    import viser

    check_port(port)
    names = [name.lower() for name in allowed_hosts]
    # viser prints a box of addresses, of which one would be taken for ours.
    with guarded((*OWN_NAMES, *names)), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=LOOPBACK, port=port, verbose=False)
    server.gui.configure_theme(show_share_button=False, show_logo=False, control_width="medium")
    server.gui.main_panel.dock_right()  # beside the picture, not over it
    return server

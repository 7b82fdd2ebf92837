"""The server answers pages of this machine alone, and nothing outside the loopback interface."""

import socket
import urllib.error
import urllib.request

import psutil
import pytest

from climatenerf.core.errors import UserError
from climatenerf.viewer.guarded_server import OWN_NAMES, check_hosts, is_allowed, start

pytest.importorskip("viser", reason="needs viser (make setup installs it)")


@pytest.mark.parametrize(
    ("host", "origin", "allowed"),
    [
        ("localhost:7007", None, True),
        ("127.0.0.1:7007", "http://127.0.0.1:7007", True),
        ("[::1]:7007", "http://[::1]:7007", True),
        ("localhost:9000", "http://localhost:9000", True),  # ssh -L 9000:...:7007
        ("localhost:7007", "http://localhost:8000", False),  # another program's page
        ("localhost:7007", "http://127.0.0.1:7007", False),
        ("localhost:7007", "https://evil.example", False),
        ("localhost:7007", "null", False),
        ("evil.example:7007", "http://evil.example:7007", False),  # DNS rebinding
        ("localhost.evil.example", None, False),
        ("", None, False),
        (None, None, False),
        ("[::1", None, False),
        ("localhost:7007", "http://[::1", False),
    ],
)
def test_host_and_origin_decide(host, origin, allowed):
    assert is_allowed(host, origin, OWN_NAMES) is allowed


@pytest.fixture(scope="module")
def server():
    started = start(0, ("box.example",))
    yield started
    started.stop()


def status(port, **headers):
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    request = urllib.request.Request(f"http://127.0.0.1:{port}/", headers=named)
    try:
        return urllib.request.urlopen(request, timeout=10).status
    except urllib.error.HTTPError as error:
        return error.code


def handshake(port, origin):
    """The status line of a websocket handshake."""
    lines = [
        "GET / HTTP/1.1", f"Host: localhost:{port}", "Upgrade: websocket", "Connection: Upgrade",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Protocol: viser-v1.1.1", f"Origin: {origin}", "", "",
    ]  # fmt: skip
    with socket.create_connection(("127.0.0.1", port), timeout=10) as link:
        link.sendall("\r\n".join(lines).encode())
        return link.recv(4096).split(b"\r\n")[0].decode()


def test_foreign_pages_get_403(server):
    port = server.get_port()
    assert status(port) == 200
    assert status(port, Host="box.example", Origin="http://box.example") == 200
    assert status(port, Host="evil.example") == 403
    assert status(port, Origin="http://evil.example") == 403
    assert " 403 " in handshake(port, "http://evil.example") + " "
    assert " 101 " in handshake(port, f"http://localhost:{port}") + " "


def test_it_listens_on_the_loopback_interface_alone(server):
    listening = [
        each.laddr.ip
        for each in psutil.Process().net_connections("tcp")
        if each.status == psutil.CONN_LISTEN and each.laddr.port == server.get_port()
    ]
    assert listening == ["127.0.0.1"]


def test_names_of_hosts_have_no_port():
    check_hosts(("box.example", "Box-2"))
    with pytest.raises(UserError, match="without port"):
        check_hosts(("box:7007",))


def test_a_port_in_use_is_told(server):
    with pytest.raises(UserError, match=r"port \d+ is in use .* --port 0 for a free one"):
        start(server.get_port())

# SPDX-License-Identifier: Apache-2.0
"""The page answers its own address and nobody without the token of its URL."""

import http.client
import re
import socket
from urllib.parse import urlsplit

import pytest

pytest.importorskip("viser", reason="needs viser: pip install .[view]")

import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from sst_ros.errors import InputError
from sst_ros.view.server import LOCAL, PageServer


def parts(server):
    """Host with port, and token, of the URL that is printed."""
    url = urlsplit(server.url)
    return url.netloc, url.query.removeprefix("token=")


def handshake(server, host=None, origin=None, cookie=None, query=""):
    """Open a websocket as a client that chooses its own headers.

    Return what came first.
    """
    own, _ = parts(server)
    address, port = own.rsplit(":", 1)
    with connect(
        f"ws://{host or own}/{query}",
        sock=socket.create_connection((address, int(port)), 10),
        origin=origin,
        subprotocols=[f"viser-v{viser.__version__}"],
        additional_headers={"Cookie": cookie} if cookie else None,
        compression=None,
        open_timeout=10,
    ) as client:
        return client.recv(timeout=10)


def get(server, path, **headers):
    own, _ = parts(server)
    connection = http.client.HTTPConnection(own, timeout=10)
    connection.putrequest("GET", path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    response = connection.getresponse()
    found = response.status, dict(response.getheaders()), response.read()
    connection.close()
    return found


def test_a_browser_that_has_the_url_is_served(server):
    own, token = parts(server)
    status, headers, body = get(server, f"/?token={token}")
    assert status == 200
    assert b"<title>sst_ros</title>" in body
    assert (
        "HttpOnly" in headers["Set-Cookie"]
        and "SameSite=Strict" in headers["Set-Cookie"]
    )
    cookie = headers["Set-Cookie"].split(";")[0]
    assert get(server, "/", Cookie=cookie)[0] == 200
    assert handshake(server, origin=f"http://{own}", cookie=cookie)
    port = own.rsplit(":", 1)[1]
    assert handshake(
        server,
        host=f"localhost:{port}",
        origin=f"http://localhost:{port}",
        cookie=cookie,
    )
    # A client without a browser sends no Origin, and may give the token in the query.
    assert handshake(server, query=f"?token={token}")


def refuse(server, **given):
    with pytest.raises(InvalidStatus) as refused:
        handshake(server, **given)
    assert refused.value.response.status_code == 403


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "null",
        "http://127.0.0.1:1",
        "https://127.0.0.1.evil.example",
    ],
)
def test_a_page_of_another_origin_is_refused_even_with_the_token(server, origin):
    refuse(server, origin=origin, query=f"?token={parts(server)[1]}")


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:18280", "127.0.0.1.evil.example"]
)
def test_a_name_that_was_rebound_to_this_machine_is_refused(server, host):
    query = f"?token={parts(server)[1]}"
    refuse(server, host=host, origin=f"http://{host}", query=query)
    assert get(server, f"/{query}", Host=host)[0] == 403


@pytest.mark.parametrize("query", ["", "?token=", "?token=guessed", "?token=%C3%A4"])
def test_nobody_enters_without_the_token(server, query):
    refuse(server, origin=f"http://{parts(server)[0]}", query=query)
    status, _, body = get(server, f"/{query}")
    assert status == 403 and b"token" in body


def test_two_pages_share_neither_port_nor_token(server):
    second = PageServer(port=18280)
    try:
        assert re.fullmatch(
            rf"http://{re.escape(LOCAL)}:\d+/\?token=[\w-]{{20,}}", second.url
        )
        assert parts(server)[0] != parts(second)[0]
        assert parts(server)[1] != parts(second)[1]
        assert second.request_share_url() is None
    finally:
        second.stop()


@pytest.mark.parametrize(
    "host", ["203.0.113.1", "no.such.host.invalid", "\ud800", "", "<broadcast>"]
)
def test_other_machines_addresses(host):
    with pytest.raises(InputError, match="address of this machine"):
        PageServer(host)


@pytest.mark.parametrize("port", [-1, 0, 80, 65536, 10**30])
def test_ports_that_are_none(port):
    with pytest.raises(InputError, match=r"port = .*must be between 1024 and 65535"):
        PageServer(port=port)

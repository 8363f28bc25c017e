# SPDX-License-Identifier: Apache-2.0
"""The web server of the page: viser's, behind a check of address, origin and token.

Everyone who reaches the page can apply torques. Every request, the websocket's too,
must therefore

- be addressed to this server (Host): no foreign name that was rebound to this machine
  is served;
- come from the page itself where a browser states where it comes from (Origin);
- carry the token of the printed URL, in the query or in the cookie that the first
  answer sets.

A viser that cannot be guarded so is refused, never served without the check.
"""

from __future__ import annotations

import contextlib
import http
import http.cookies
import io
import ipaddress
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import parse_qs, urlsplit

import websockets.asyncio.server
from viser import ViserServer
from websockets import Request, Response
from websockets.asyncio.server import ServerConnection

from sst_ros.errors import SstError, refusal, refuse_errors, refuse_unless

LOCAL = "127.0.0.1"
PORT = 8080
TITLE = "sst_ros"
COOKIE = "sst_view_{}"
"""Name of the cookie of the page at a port: pages of one address share cookies."""
_FIRST_PORT = 1024
_LAST_PORT = 65535
_TRIED = 100
"""Ports that are tried, from the given one on."""

Handler = Callable[[ServerConnection, Request], Response | None]
_starting = threading.Lock()


class AccessCheck:
    """Answers 403 to every request that is not the page's own; see the module."""

    def __init__(self, host: str) -> None:
        self.token = secrets.token_urlsafe(24)
        self.installed = False
        self._names = {host.lower()}
        if not _loopback(host):
            self._names |= {socket.gethostname().lower(), socket.getfqdn().lower()}

    def guard(self, serve_files: Handler) -> Handler:
        """Return viser's handler of requests, behind the check."""
        self.installed = True

        def handler(connection: ServerConnection, request: Request) -> Response | None:
            reason = self.refusal(connection.local_address, request)
            if reason:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
            if urlsplit(request.path).path == "/":
                # the title is in the page's text
                request.headers.pop("Accept-Encoding", None)
            response = serve_files(connection, request)
            if response is not None and response.status_code == http.HTTPStatus.OK:
                self._complete(response, connection.local_address[1])
            return response

        return handler

    def refusal(self, local: tuple[str, int], request: Request) -> str:
        """Return why a request at a local address is refused; empty if it is not."""
        address, port = local
        hosts = request.headers.get_all("Host")
        names = self._names | {address}
        if _loopback(address):
            names |= {"localhost"}
        if len(hosts) != 1 or _name(hosts[0]) not in names:
            return "This page answers only to its own address."
        own_origins = (f"http://{hosts[0]}", f"https://{hosts[0]}")
        for origin in request.headers.get_all("Origin"):
            if origin not in own_origins:
                return "Another page must not use this one."
        if not any(map(self._is_token, _tokens_of(request, port))):
            return (
                "Open the address that `view` has printed: it contains the access"
                " token."
            )
        return ""

    def _is_token(self, token: str) -> bool:
        """Compare in a time that does not depend on the token."""
        return secrets.compare_digest(token.encode(), self.token.encode())

    def _complete(self, response: Response, port: int) -> None:
        """Set the cookie, and the title of the browser's tab.

        Forbid frames and referrers.
        """
        headers = response.headers
        title = f"<title>{TITLE}</title>".encode()
        response.body = response.body.replace(b"<title>Viser</title>", title, 1)
        del headers["Content-Length"]
        headers["Content-Length"] = str(len(response.body))
        cookie = f"{COOKIE.format(port)}={self.token}"
        headers["Set-Cookie"] = f"{cookie}; HttpOnly; SameSite=Strict; Path=/"
        headers["X-Frame-Options"] = "DENY"
        headers["Referrer-Policy"] = "no-referrer"


def _tokens_of(request: Request, port: int) -> list[str]:
    """Return the tokens in the address and in the cookie of a request."""
    cookies = http.cookies.SimpleCookie()
    with contextlib.suppress(http.cookies.CookieError):
        cookies.load("; ".join(request.headers.get_all("Cookie")))
    tokens = parse_qs(urlsplit(request.path).query).get("token", [])
    cookie = cookies.get(COOKIE.format(port))
    if cookie is not None:
        tokens.append(cookie.value)
    return tokens


class PageServer(ViserServer):
    """viser's server at `url` with the check and without a public share.

    The search for a port is bounded. Raises InputError where the host is no address of
    this machine, or no port is free.
    """

    def __init__(self, host: str = LOCAL, port: int = PORT) -> None:
        check = AccessCheck(host)
        # viser's messages
        with contextlib.redirect_stdout(io.StringIO()), _swap_serve(check):
            super().__init__(host, _free_port(host, port), label=TITLE, verbose=False)
        if not check.installed:
            self.stop()
            raise SstError(
                "this release of viser cannot be guarded: pip install 'viser>=1.1,<2'"
            )
        url_host = f"[{host}]" if ":" in host else host
        self.url = f"http://{url_host}:{self.get_port()}/?token={check.token}"

    def stop(self) -> None:
        """Stop serving."""
        with contextlib.redirect_stdout(io.StringIO()):
            super().stop()

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse to publish the page by a server elsewhere: it drives a machine."""
        return None


@contextlib.contextmanager
def _swap_serve(check: AccessCheck) -> Iterator[None]:
    """Put the check before viser's own handler in the call that starts its web server.

    viser 1.1 neither takes a handler of requests nor hands on the server that it
    starts, and hears of a client only when its websocket is open; so `websockets` gets
    another `serve` meanwhile.
    """
    module = vars(websockets.asyncio.server)

    def serve(*args: Any, process_request: Handler, **options: Any) -> Any:
        return original(*args, process_request=check.guard(process_request), **options)

    with _starting:
        original = module["serve"]
        module["serve"] = serve
        try:
            yield
        finally:
            module["serve"] = original


def _free_port(host: str, port: int) -> int:
    """Return the first free port.

    Viser would look without end, or stop with a traceback.
    """
    is_port = _FIRST_PORT <= port <= _LAST_PORT
    requirement = f"must be between {_FIRST_PORT} and {_LAST_PORT}"
    refuse_unless("view", ("port", port, is_port, requirement))
    requirement = "must be an address of this machine"
    with refuse_errors("view", "host", host, requirement, OSError, ValueError):
        # An empty name would be every address: getaddrinfo knows none of it.
        addresses = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)
        _listen(addresses, 0)
    last = min(port + _TRIED - 1, _LAST_PORT)
    for tried in range(port, last + 1):
        with contextlib.suppress(OSError):
            _listen(addresses, tried)
            return tried
    raise refusal("view", "port", port, f"no port up to {last} is free")


def _listen(addresses: list[Any], port: int) -> None:
    """Listen at a port of all addresses, and end.

    Raise an OSError where that cannot be.
    """
    for family, _, _, _, address in addresses:
        socket.create_server((address[0], port, *address[2:]), family=family).close()


def _name(host: str) -> str:
    """Return the name in a Host header, without port and brackets."""
    with contextlib.suppress(ValueError):
        return urlsplit(f"//{host}").hostname or ""
    return ""


def _loopback(address: str) -> bool:
    """Return whether only this machine reaches an address."""
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return address.lower() == "localhost"

"""A page for one user: served on loopback, by a token, with a WebSocket that strangers cannot open.

As Jupyter does it: the address that is printed has a random token; the page then has it as a
cookie, which no other site's page makes the browser send (`SameSite=Strict`). A WebSocket is
opened with that cookie, and by a page of this server only: browsers say in `Origin` whose page
asks. On loopback the `Host` must be a loopback name as well, so that no name of a stranger's that
points here is served. Its port may be any, as a tunnel's other end may have another one.
"""

import base64
import hashlib
import hmac
import logging
import re
import secrets
from collections.abc import Callable
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs

from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve

LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
SOCKET = "/socket"
MOST_BYTES = 1 << 16
"""Largest message that a page may send."""
_LOCAL = re.compile(rf"({'|'.join(map(re.escape, LOOPBACK))})(:[0-9]{{1,5}})?", re.IGNORECASE)
_MISSING = (
    "This page is its user's: open the address that `codesign studio` printed, with its token.\n"
)
_TUNNEL = (
    "From another machine take a tunnel, `ssh -L {port}:localhost:{port} HOST`, and open the "
    "address that `codesign studio` printed there.\n"
)


class Guard:
    """Who is answered, and with what, before a WebSocket is opened.

    Attributes:
      token: What the address that the user opens has.
    """

    def __init__(self, page: str, *, everywhere: bool) -> None:
        """Takes the page, and whether hosts other than loopback are served."""
        self.token = secrets.token_urlsafe(24)
        self._everywhere = everywhere
        self._body = page.encode()
        digests = [
            base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
            for script in re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
        ]
        sources = " ".join(f"'sha256-{digest}'" for digest in digests)
        self._sources = (
            f"default-src 'none'; script-src {sources}; style-src 'unsafe-inline'; img-src data:; "
            "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )

    def answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The page, a refusal, or None: a WebSocket may be opened."""
        headers = request.headers
        path, _, query = request.path.partition("?")
        hosts = headers.get_all("Host")
        origins = headers.get_all("Origin")
        tunnel = _TUNNEL.format(port=connection.local_address[1])
        if getattr(request, "method", "GET") != "GET":  # websockets < 17 refuses these itself
            refusal = connection.respond(HTTPStatus.METHOD_NOT_ALLOWED, "")
            refusal.headers["Allow"] = "GET"
            return refusal
        if len(hosts) != 1 or not (self._everywhere or _LOCAL.fullmatch(hosts[0])):
            words = "The page is served to names of this machine alone, such as localhost. "
            return connection.respond(HTTPStatus.FORBIDDEN, words + tunnel)
        # Cookies of a host are shared by its ports: each port has one. The port is the one that
        # the browser knows, as tunnels to two machines may lead to one port there.
        port = re.search(r":([0-9]{1,5})$", hosts[0])
        cookie = f"codesign-studio-{port[1] if port else 80}"
        if path == SOCKET:
            same_origin = [[f"{scheme}://{hosts[0]}"] for scheme in ("http", "https")]
            if origins not in same_origin or not self._known(_cookie(headers, cookie)):
                return connection.respond(HTTPStatus.FORBIDDEN, _MISSING)
            return None
        if path != "/":
            words = "There is the page / alone. A proxy has to take its own path away. "
            return connection.respond(HTTPStatus.NOT_FOUND, words + tunnel)
        token = parse_qs(query).get("token", [""])[0]
        if not (self._known(token) or self._known(_cookie(headers, cookie))):
            return connection.respond(HTTPStatus.FORBIDDEN, _MISSING)
        more = Headers()
        more["Content-Type"] = "text/html; charset=utf-8"
        more["Content-Length"] = str(len(self._body))
        more["Connection"] = "close"
        more["Content-Security-Policy"] = self._sources
        more["Cache-Control"] = "no-store"
        more["Referrer-Policy"] = "no-referrer"
        more["X-Content-Type-Options"] = "nosniff"
        # Without a path: the browser takes the page's, so that a proxy's other pages do not get it.
        more["Set-Cookie"] = f"{cookie}={self.token}; HttpOnly; SameSite=Strict"
        return Response(HTTPStatus.OK, "OK", more, self._body)

    def _known(self, token: str) -> bool:
        return hmac.compare_digest(token.encode("utf-8", "replace"), self.token.encode())


def _cookie(headers: Headers, name: str) -> str:
    """The value of a cookie; empty without one."""
    for text in headers.get_all("Cookie"):
        try:
            if morsel := SimpleCookie(text).get(name):
                return morsel.value
        except CookieError:
            continue
    return ""


def listen(guard: Guard, tab: Callable[[ServerConnection], None], host: str, port: int) -> Server:
    """A server that listens, and serves once `serve_forever` is called."""
    quiet = logging.getLogger(__name__)
    quiet.setLevel(logging.CRITICAL)  # what strangers send is no error of ours
    return serve(
        tab,
        host,
        port,
        process_request=guard.answer,
        compression=None,  # which takes longer than loopback
        max_size=MOST_BYTES,
        close_timeout=1,
        logger=quiet,
        server_header=None,
    )

"""Web page for watching a service, with its metrics, on one port: for this machine, or with a token for others."""

import asyncio
import hmac
import ipaddress
import json
import os
import re
import socket
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager, suppress
from importlib.resources import files
from typing import NamedTuple

import uvicorn
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import HTTPConnection, Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from heliograph.numerics.check import fail
from heliograph.serving.observation.answers_between_batches import LastAnswers
from heliograph.serving.observation.metrics import ServiceMetrics
from heliograph.serving.observation.service_watch import LISTED, ServiceWatch
from heliograph.serving.observation.trouble_overview import make_plants_page

STUCK = 60.0  # seconds after which a batch that is being taken is no sign of health
TOKEN = "HELIOGRAPH_PAGE_TOKEN"
LEAST_TOKEN = 16  # characters of a token
HEALTH = "/healthz"
EVERY = 0.5  # seconds between looks
NAME = re.compile(r"[A-Za-z0-9._-]+|\[[0-9a-fA-F:.]+\]")
LOOPBACK = ["localhost", "127.0.0.1", "[::1]"]
KINDS = {"page.css": "text/css", "page.js": "text/javascript"}
POLICY = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
}


class PageAddress(NamedTuple):
    """Address of the page, the token that is required there, and the names by which it is asked for.

    Without a token only this machine can reach it. `hosts`: names besides those of this machine, such as a proxy's.
    """

    host: str
    port: int
    token: str | None
    hosts: tuple[str, ...] = ()


def parse_page_address(
    address: str, environment: Mapping[str, str] | None = None, hosts: Sequence[str] = ()
) -> PageAddress:
    """Return where a page is served: `PORT`, of this machine alone, or `ADDRESS:PORT`, with its token and hosts.

    The token is a password for the page, read from the environment variable HELIOGRAPH_PAGE_TOKEN. An address that
    other machines can reach needs one; at a loopback address it is optional.

    Args:
        address: `PORT` or `ADDRESS:PORT`.
        environment: environment variables; by default those of the process.
        hosts: names by which a proxy or others ask for the page, without a port.

    Raises:
        ValueError: no such address; one that others can reach without a token; a token of less than 16 characters; a
            name that is none.
    """
    host, _, port = address.rpartition(":")
    host = host.strip("[]") or "127.0.0.1"
    if not (port.isascii() and port.isdigit() and int(port) < 65536):
        raise fail("page", "a port, or address:port", repr(address))
    for name in hosts:
        if not NAME.fullmatch(name):
            raise fail("page, host", "a name without scheme and port, such as pages.example.org", repr(name))
    token = (os.environ if environment is None else environment).get(TOKEN, "")
    if _is_loopback(host) and not token:
        return PageAddress(host, int(port), token=None, hosts=tuple(hosts))
    if len(token) < LEAST_TOKEN:
        expected = f"a token of {LEAST_TOKEN} characters at least in {TOKEN}"
        raise fail(f"page at {host}", expected, f"one of {len(token)}")
    return PageAddress(host, int(port), token, tuple(hosts))


def _is_loopback(host: str) -> bool:
    """Return whether a host is this machine's own loopback, which others cannot reach."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def make_overview_page(watch: ServiceWatch) -> str:
    """Return the page of all plants, the worst first."""
    return make_plants_page(watch.title, {name for name, _ in watch.plants()}, watch.list_worst_plants(), LISTED)


def make_application(
    watch: ServiceWatch, token: str | None, stopped: asyncio.Event, hosts: Sequence[str] = ()
) -> Starlette:
    """Return the web application: the page at /, its data at /events until `stopped`, metrics at /metrics.

    Args:
        watch: the counts and states of the running service.
        token: secret that each request must show; None for a page that needs none.
        stopped: set when the service stops, so that open streams of views end.
        hosts: names under which the page may be asked for, beside those of this machine. Without a token, or where
            `hosts` are given, requests for other names are refused, so that no foreign page can lead here.
    """
    counts = ServiceMetrics(watch)
    overview = LastAnswers(watch.lock, lambda _: make_overview_page(watch), make_overview_page(watch))

    def page(request: Request) -> Response:
        """Answer with the page, where the first view replaces the first "null"; later views come from /events."""
        # "<" is escaped, so that no name in the view can end the HTML element around it.
        first = json.dumps(watch.make_page_data(request.query_params.get("plant"))).replace("<", "\\u003c")
        return Response(_read_page_file("page.html").replace("null", first, 1), media_type="text/html", headers=POLICY)

    def metrics(_: Request) -> Response:
        """Answer with all counts, in the text format of Prometheus."""
        return Response(counts.text(), media_type=CONTENT_TYPE_LATEST)

    def events(request: Request) -> Response:
        """Answer with a stream of views, a server-sent event each."""
        return StreamingResponse(_yield_events(watch, request, stopped), media_type="text/event-stream")

    def plants(_: Request) -> Response:
        """Answer with the page of all plants."""
        return Response(overview.ask(), media_type="text/html", headers=POLICY)

    def health(_: Request) -> Response:
        """Answer 503 if a batch has taken more than STUCK seconds so far, else "ok"; this tells no secret to guard."""
        busy = watch.busy()
        if busy > STUCK:
            return PlainTextResponse(f"a batch has been taken for {busy:.0f} s", 503)
        return PlainTextResponse("ok")

    answers = {"/": page, "/metrics": metrics, "/events": events, "/plants": plants, HEALTH: health}
    answers |= {f"/{name}": send_page_file for name in KINDS}
    routes = [Route(path, answer) for path, answer in answers.items()]
    return Starlette(routes=routes, middleware=_make_middleware(token, hosts))


def _make_middleware(token: str | None, hosts: Sequence[str]) -> list[Middleware]:
    """Return the checks of each request: of its host, if that is needed, and then of its token.

    A request names the host that it asks for. It must be a name of this machine or one of `hosts`, so that a foreign
    page whose name was made to lead here cannot get in. With a token and no `hosts`, the token ensures this.
    """
    middleware = [Middleware(TokenMiddleware, token)]
    if token is None or hosts:
        allowed = [*LOOPBACK, *hosts]
        middleware.insert(0, Middleware(TrustedHostMiddleware, allowed_hosts=allowed, www_redirect=False))
    return middleware


def _read_page_file(name: str) -> str:
    """Return a file of the page as text."""
    return (files("heliograph.serving.observation") / "browser" / name).read_text("utf-8")


def send_page_file(request: Request) -> Response:
    """Return the file of the page that a request names."""
    name = request.url.path.removeprefix("/")
    return Response(_read_page_file(name), media_type=KINDS[name], headers=POLICY)


async def _yield_events(watch: ServiceWatch, request: Request, stopped: asyncio.Event) -> AsyncIterator[str]:
    """Yield the page's data as a server-sent event whenever they have changed, else a comment.

    A comment shows whether the reader has gone. Each event has only the chart points that are newer than the last
    one's, of which `since` is the number. Without a plant in the request, the first plant with points is followed.
    """
    plant, since, text_before = request.query_params.get("plant"), 0, None
    while not (stopped.is_set() or await request.is_disconnected()):
        view = await asyncio.to_thread(watch.make_page_data, plant, since)
        since = view["newest"]
        if view["points"]:
            plant = view["plant"]
        text = json.dumps(view)
        yield f"data: {text}\n\n" if text != text_before else ": \n\n"
        text_before = text
        with suppress(TimeoutError):
            await asyncio.wait_for(stopped.wait(), EVERY)


class TokenMiddleware:
    """Middleware that requires the token: as `Authorization: Bearer`, or once as ?token=, then kept as a cookie."""

    def __init__(self, app: ASGIApp, token: str | None):
        """Wrap the web application `app`; a request needs this token, or none where it is None."""
        self.app, self.token = app, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer only requests that bring the token, in their address (kept as a cookie then), a cookie or a header."""
        if scope["type"] != "http" or self.token is None or scope["path"] == HEALTH:  # health is no secret
            await self.app(scope, receive, send)
            return
        requested = HTTPConnection(scope)
        in_cookie, in_header = requested.cookies.get("heliograph", ""), _read_bearer_token(requested)
        if self._matches_token(requested.query_params.get("token", "")):
            # Keep it as a cookie, and lead to the address without it.
            answer: Response = RedirectResponse("/", 303)
            answer.set_cookie("heliograph", self.token, httponly=True, samesite="strict")
            await answer(scope, receive, send)
        elif self._matches_token(in_cookie) or self._matches_token(in_header):
            await self.app(scope, receive, send)
        else:
            await PlainTextResponse("a token is needed: ?token=", 401)(scope, receive, send)

    def _matches_token(self, given: str) -> bool:
        """Return whether what was given is the token, in a time that says nothing of where it differs."""
        return hmac.compare_digest(given.encode(), str(self.token).encode())


def _read_bearer_token(requested: HTTPConnection) -> str:
    """Return the token of the header `Authorization: Bearer`, or ""."""
    kind, _, token = requested.headers.get("authorization", "").partition(" ")
    return token if kind.lower() == "bearer" else ""


class _PageServer(uvicorn.Server):
    """Web server next to a service; only the service handles signals."""

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture no signals: they stop the service, and with it the page."""
        yield


@asynccontextmanager
async def serve_page(watch: ServiceWatch, at: PageAddress) -> AsyncIterator[int]:
    """Serve the page for the duration of a block, which receives its port.

    Args:
        watch: the observer of the services.
        at: where; port 0 takes any that is free.

    Raises:
        ValueError: an address that is taken, or not this machine's.
    """
    try:
        listener = socket.create_server((at.host, at.port), family=_address_family(at.host))
    except OSError as error:
        why = str(error.strerror).split(" (")[0]  # without the address again
        raise fail("page", "a free port of this machine", f"{at.host}:{at.port}, {why}") from None
    # Readers of the page would hold the server: they are told when it stops, and have three seconds.
    stopped = asyncio.Event()
    application = make_application(watch, at.token, stopped, at.hosts)
    server = _PageServer(
        uvicorn.Config(application, log_level="warning", access_log=False, timeout_graceful_shutdown=3)
    )
    serving = asyncio.ensure_future(server.serve([listener]))
    try:
        _, port, *_ = listener.getsockname()
        yield int(port)
    finally:
        stopped.set()
        server.should_exit = True
        await serving


def _address_family(host: str) -> socket.AddressFamily:
    """Return the family of sockets for a host: IPv6 where its address has a colon."""
    return socket.AF_INET6 if ":" in host else socket.AF_INET

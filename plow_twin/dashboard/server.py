"""Server of the screen, run as a separate process: `python -m plow_twin.dashboard.server LINK SOCKET`.

A slow page receives fewer updates, and does not delay other pages.
"""

from __future__ import annotations

import asyncio
import json
import socket
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.routing import Mount, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from plow_twin.dashboard.access import PageAccess
from plow_twin.dashboard.beside import join_twin
from plow_twin.dashboard.board import Board
from plow_twin.dashboard.link import Link

PAGE: Final = Path(__file__).with_name("page")
#: Largest number of open pages.
MOST_PAGES: Final = 50
#: Longest time in which a page must receive an update or send its token [s].
_PATIENCE_S: Final = 20.0
#: Longest time between two messages to a page, and shortest time between two requests of a page [s].
_WORD_S, _WISH_S = 1.0, 0.2
_WISH: Final = 4096
#: Increment of `nice`, so that the twin has priority.
_NICE: Final = 10
#: Codes of the WebSocket protocol with which a page is closed.
TOO_MANY, NO_TOKEN, ENDED = 1013, 4401, 1001
_HEADERS: Final = {
    "Content-Security-Policy": "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class Guard:
    """Middleware that refuses requests under foreign host names, and requests from pages of other sites."""

    def __init__(self, app: ASGIApp, access: PageAccess) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request to the application, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        own = self._access.answers_to(host) and self._access.is_own(headers.get("origin"), host)

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        if own:
            await self._app(scope, receive, send_with_headers)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": NO_TOKEN})
        else:
            text = "the screen is not offered under this name, or to this page"
            await PlainTextResponse(text, 403)(scope, receive, send_with_headers)


class Pages:
    """The open pages that show a board. The requests of the pages are sent through a link."""

    def __init__(self, board: Board, link: Link, access: PageAccess) -> None:
        self._board, self._link, self._access = board, link, access

    async def page(self, socket: WebSocket) -> None:
        """Serve a page until it is closed."""
        await socket.accept()
        with suppress(WebSocketDisconnect, TimeoutError, RuntimeError):  # the page is closed, or reads no messages
            if self._access.token and not await self._is_admitted(socket):
                await socket.close(NO_TOKEN, "a token is needed")
            elif self._board.pages >= MOST_PAGES:
                await socket.close(TOO_MANY, f"{MOST_PAGES} pages are open")
            else:
                await self._serve(socket)

    async def _is_admitted(self, socket: WebSocket) -> bool:
        """Receive the token of a page. After a wrong token, wait one second."""
        wish = await asyncio.wait_for(_wish(socket), _PATIENCE_S)
        if self._access.admits(wish.get("token")):
            return True
        await asyncio.sleep(1.0)
        return False

    async def _serve(self, socket: WebSocket) -> None:
        self._board.pages += 1
        tasks = [asyncio.ensure_future(work) for work in (self._send_updates(socket), self._listen(socket))]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            self._board.pages -= 1
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _send_updates(self, socket: WebSocket) -> None:
        board, version, skipped = self._board, 0, 0
        while not self._link.broken:
            news = board.news
            if board.version == version:
                with suppress(TimeoutError):
                    await asyncio.wait_for(news.wait(), _WORD_S)
            skipped += max(0, board.version - version - 1) if version else 0
            message = {**board.since(version), "skipped": skipped}
            version = board.version
            await asyncio.wait_for(socket.send_text(json.dumps(message, separators=(",", ":"))), _PATIENCE_S)
        await socket.close(ENDED, "the twin has ended")

    async def _listen(self, socket: WebSocket) -> None:
        while True:
            wish = await _wish(socket)
            if wish.get("do") in ("acknowledge", "mark"):
                self._link.send({"do": wish["do"], "text": str(wish.get("text", "")).strip()})
                await asyncio.sleep(_WISH_S)


async def _wish(socket: WebSocket) -> dict[str, Any]:
    try:
        message = json.loads(await socket.receive_text())
    except (ValueError, KeyError):
        return {}
    return message if isinstance(message, dict) else {}


def application(board: Board, link: Link, access: PageAccess) -> ASGIApp:
    """Return the web application, which serves the page and its data."""
    pages = Pages(board, link, access)
    routes = [WebSocketRoute("/data", pages.page), Mount("/", StaticFiles(directory=PAGE, html=True))]
    return Guard(Starlette(routes=routes), access)


async def serve(link: Link, listening: socket.socket, access: PageAccess) -> None:
    """Serve until the other end of the link is closed."""
    board = Board()
    config = uvicorn.Config(
        application(board, link, access),
        lifespan="off",
        log_level="error",
        access_log=False,
        ws_max_size=_WISH,
        ws_per_message_deflate=False,
        timeout_graceful_shutdown=1,
    )
    server = uvicorn.Server(config)

    def take() -> None:
        while (update := link.receive()) is not None:
            board.add(update)
        if link.broken:
            asyncio.get_running_loop().remove_reader(link.fileno())
            board.wake()
            server.should_exit = True

    asyncio.get_running_loop().add_reader(link.fileno(), take)
    await server.serve(sockets=[listening])


def main() -> None:
    """Serve on the two file descriptors in the arguments.

    The first message on the link contains the address and the token.
    """
    link, access = join_twin(_NICE)
    listening = socket.socket(fileno=int(sys.argv[2]))
    asyncio.run(serve(link, listening, PageAccess(**access)))


if __name__ == "__main__":
    main()

"""A legacy robot in any of several WebSocket libraries: base64 images out, text in, motors that latch, no watchdog.

    python legacy_robot.py LIBRARY FORMAT PORT PICTURES MOTORS.csv [PAGE]

FORMAT is `bar`, `dashed` (which reads the axes swapped, as the article's robot did) or `boxes`. As there, text that the
format does not contain raises an error, and the library then closes the connection as it always does. It writes
`t_us,linear,angular` for each command. With the how-to PAGE of legacy robots it runs the watchdog of that page.
"""

import asyncio
import base64
import contextlib
import importlib
import itertools
import sys
import threading
import time
from pathlib import Path

FPS = 20


class Motors:
    """The last command, for ever, unless there is a watchdog."""

    def __init__(self, form, path, page=None):
        self._feed = watchdog_of(page)(lambda: self._set(0.0, 0.0)) if page else lambda: None
        self._apply = {"bar": self._bar, "dashed": self._dashed, "boxes": self._boxes}[form]
        self._log = open(path, "a", buffering=1)  # noqa: PTH123, SIM115

    def on_text(self, text):
        """Apply one message."""
        self._set(*self._apply(text))
        self._feed()

    def _set(self, linear, angular):
        self._log.write(f"{time.monotonic_ns() // 1000},{linear},{angular}\n")

    @staticmethod
    def _bar(text):
        data = text.split("|")
        return float(data[0]), float(data[1])

    @staticmethod
    def _dashed(text):
        data = text.split("-")
        return float(data[1]), float(data[0])

    @staticmethod
    def _boxes(text):
        """Drive toward the widest box. Without one, stop."""
        widest = None
        for box in text.split("-"):
            if len(box) > 10:
                x = box.split(",")
                left, right = float(x[1]), float(x[3])
                widest = max(widest or (0, 0), (right - left, (left + right) / 2))
        return (0.3, 0.5 - widest[1]) if widest else (0.0, 0.0)


def watchdog_of(page):
    """Run the block of the page."""
    names = {}
    exec(Path(page).read_text("utf-8").partition("<!-- watchdog -->\n```python\n")[2].partition("```")[0], names)
    return names["watchdog"]


def texts_of(folder):
    return [base64.encodebytes(path.read_bytes()).decode() for path in sorted(Path(folder).glob("*.jpg"))]


def film(texts, send):
    """Call `send` with one image after another, on a thread."""

    def run():
        for text in itertools.cycle(texts):
            with contextlib.suppress(Exception):
                send(text)
            time.sleep(1 / FPS)

    threading.Thread(target=run, daemon=True).start()


async def film_to(texts, send):
    """Send the images to one client, in asyncio."""
    for text in itertools.cycle(texts):
        await send(text)
        await asyncio.sleep(1 / FPS)


def simple_websocket_server(motors, port, texts, module):
    """The article's library (`SimpleWebSocketServer`), or its successor with other names."""
    clients = []

    class Hub(module.WebSocket):
        def handleMessage(self):  # noqa: N802
            motors.on_text(self.data)

        def handleConnected(self):  # noqa: N802
            clients.append(self)

        def handleClose(self):  # noqa: N802
            clients.remove(self)

        handle, connected = handleMessage, handleConnected

        def handle_close(self):
            clients.remove(self)

    def send(text):
        for client in list(clients):
            getattr(client, "sendMessage", getattr(client, "send_message", None))(text)

    film(texts, send)
    server = getattr(module, "SimpleWebSocketServer", getattr(module, "WebSocketServer", None))("127.0.0.1", port, Hub)
    getattr(server, "serveforever", getattr(server, "serve_forever", None))()


def article(motors, port, texts):
    simple_websocket_server(motors, port, texts, importlib.import_module("SimpleWebSocketServer"))


def successor(motors, port, texts):
    simple_websocket_server(motors, port, texts, importlib.import_module("simple_websocket_server"))


def websockets(motors, port, texts):
    from websockets.asyncio.server import serve

    async def handler(client):
        filming = asyncio.ensure_future(film_to(texts, client.send))
        try:
            async for text in client:
                motors.on_text(text)
        finally:
            filming.cancel()

    async def main():
        async with serve(handler, "127.0.0.1", port):
            await asyncio.Future()

    asyncio.run(main())


def uvicorn(motors, port, texts):
    import uvicorn as module

    async def app(scope, receive, send):
        if scope["type"] != "websocket":
            return
        await receive()
        await send({"type": "websocket.accept"})
        filming = asyncio.ensure_future(film_to(texts, lambda text: send({"type": "websocket.send", "text": text})))
        try:
            while (event := await receive())["type"] == "websocket.receive":
                motors.on_text(event["text"])
        finally:
            filming.cancel()

    module.run(app, host="127.0.0.1", port=port, log_level="critical", lifespan="off")


def websocket_server(motors, port, texts):
    from websocket_server import WebsocketServer

    server = WebsocketServer(host="127.0.0.1", port=port)
    server.set_fn_message_received(lambda client, server, text: motors.on_text(text))
    film(texts, server.send_message_to_all)
    server.run_forever()


def aiohttp(motors, port, texts):
    from aiohttp import web

    async def handler(request):
        client = web.WebSocketResponse()
        await client.prepare(request)
        filming = asyncio.ensure_future(film_to(texts, client.send_str))
        try:
            async for message in client:
                motors.on_text(message.data)
        finally:
            filming.cancel()
        return client

    app = web.Application()
    app.add_routes([web.get("/", handler)])
    web.run_app(app, host="127.0.0.1", port=port, print=None)


def tornado(motors, port, texts):
    from tornado import ioloop, web, websocket

    class Hub(websocket.WebSocketHandler):
        def check_origin(self, _origin):
            return True

        def open(self):
            self.filming = asyncio.ensure_future(film_to(texts, self.write_message))

        def on_message(self, message):
            motors.on_text(message)

        def on_close(self):
            self.filming.cancel()

    async def main():
        web.Application([("/", Hub)]).listen(port, "127.0.0.1")
        await asyncio.Future()

    ioloop.IOLoop.current().run_sync(main)


LIBRARIES = {one.__name__: one for one in (
    article, successor, websockets, uvicorn, websocket_server, aiohttp, tornado)}

if __name__ == "__main__":
    LIBRARIES[sys.argv[1]](Motors(sys.argv[2], *sys.argv[5:]), int(sys.argv[3]), texts_of(sys.argv[4]))

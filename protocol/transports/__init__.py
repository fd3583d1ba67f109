"""A `Link` over Zenoh, WebSocket or memory.

May import: `protocol`. Only `zenoh/` imports zenoh, only `websocket/` imports websockets.
Interface: `link.Link`; `open.open_link` creates a link from endpoints.
"""

"""A `Link` over Zenoh, WebSocket or memory. Only zenoh/ imports zenoh, only websocket/ imports websockets."""

"""Ways to carry messages. Only this package imports zenoh or websockets."""

"""The vision service: a frame in, a command out."""

"""Alternatives that a user can build: the same images, the same detector, other transports.

May import: as `benchmarks`; zenoh, websockets and ZeroMQ, used like in other projects.
Interface: `python -m sightline.benchmarks.peers NAME ROLE SETTINGS`.
"""

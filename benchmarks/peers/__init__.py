"""Alternatives that a user can build: the same images, the same detector, other transports.

May import: as `benchmarks`; zenoh, websockets and ZeroMQ as other projects use them.
Interface: `python -m sightline.benchmarks.peers NAME ROLE SETTINGS`.
"""

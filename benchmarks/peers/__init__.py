"""What else a user might have built: the same images, the same detector, other transports.

May import: as `benchmarks`; zenoh, websockets and ZeroMQ as other projects use them.
Interface: `python -m sightline.benchmarks.peers NAME ROLE SETTINGS`.
"""

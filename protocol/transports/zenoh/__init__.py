"""Modules of sightline.protocol.transports.zenoh."""

"""Modules of protocol.transports.zenoh."""

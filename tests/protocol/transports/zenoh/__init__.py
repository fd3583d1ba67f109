"""Modules of tests.protocol.transports.zenoh."""

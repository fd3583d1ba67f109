"""Modules of tests.protocol.transports."""

"""Modules of tests.protocol.transports.websocket."""

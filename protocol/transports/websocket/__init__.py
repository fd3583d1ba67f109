"""Modules of protocol.transports.websocket."""

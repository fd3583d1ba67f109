"""Modules of sightline.protocol.transports.websocket."""

"""WebSocket as a `Link`: the sub-protocol `sightline.v1` and the legacy protocol."""

"""WebSocket as a `Link`: the sub-protocol `sightline.v1` and the legacy protocol.

May import: `protocol`, websockets.
Interface: `link.WebSocketLink`; `framing` and `legacy` are pure and public.
"""

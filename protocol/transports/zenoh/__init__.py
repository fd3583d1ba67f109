"""Zenoh as a `Link`."""

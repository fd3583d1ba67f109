"""Generates the specification from the models: README tables, JSON Schema, AsyncAPI and golden vectors.

May import: `protocol`. No service imports this folder.
Interface: `python -m sightline.protocol.spec.generate --write` or `--verify`.
"""

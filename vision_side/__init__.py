"""The vision service: a frame in, a command out.

May import: `protocol`.
Interface: `pipeline.Pipeline` turns frames into commands; `serving` runs it; `config.VisionConfig`.
"""

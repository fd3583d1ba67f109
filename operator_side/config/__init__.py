"""The configuration of a service: loaded, validated, explained and written.

May import: `protocol`, the configuration models of the sides.
Interface: `loading` creates a model from file, environment and `--set`; `errors` formats a problem as one line.
"""

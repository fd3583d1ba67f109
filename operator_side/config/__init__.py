"""The configuration of a service: read, checked, explained and written.

May import: `protocol`, the configuration models of the sides.
Interface: `loading` makes a model from file, environment and `--set`; `errors` makes one line of a problem.
"""

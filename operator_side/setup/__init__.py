"""One-time setup: keys, services that start with the machine, a router.

May import: `protocol`, `operator_side`.
Interface: `keys`, `install`, `router`.
"""

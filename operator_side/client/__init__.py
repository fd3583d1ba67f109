"""Clients of a robot and its vision service, over any link.

May import: `protocol`, `operator_side`.
Interface: `requests` (arm, STOP ...), `missions`, `status`, `discovery`, and `pictures` for a robot's images.
"""

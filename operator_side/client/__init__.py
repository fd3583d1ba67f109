"""A robot and its vision service as an operator reaches them, over any link.

May import: `protocol`, `operator_side`.
Interface: `requests` (arm, STOP ...), `missions`, `status`, `discovery`, and frames to look at.
"""

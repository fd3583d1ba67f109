"""Modules of operator_side.client."""

"""Modules of protocol.spec."""

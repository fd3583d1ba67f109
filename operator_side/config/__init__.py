"""The configuration of a service: read, checked, explained and written."""

"""Pages for the operator and metrics for Prometheus, over HTTP on this machine.

May import: `protocol`, `operator_side`.
Interface: `watch_page` and `metrics`, each an HTTP server.
"""

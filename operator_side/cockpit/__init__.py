"""Pages for the operator and metrics for Prometheus, over HTTP on this machine."""

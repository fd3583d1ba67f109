"""A conformance kit for any peer: numbered cases against protocol/README.md."""

"""The conformance kit: cases that test any peer over the network, point by point against `protocol/README.md`."""

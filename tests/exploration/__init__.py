"""Exhaustive exploration of the real gate, lease and STOP latch: every order of events, both promises in each state."""

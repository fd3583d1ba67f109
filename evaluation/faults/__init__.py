"""The fault bench: real processes, injected faults, judged from the simulated motors' own log."""

"""Cases for visions, by chapter of the specification."""

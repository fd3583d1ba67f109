"""Camera plug-ins."""

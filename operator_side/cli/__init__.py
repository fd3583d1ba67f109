"""The command line, one file per group of commands. It composes every other package; nothing imports it."""

"""The command line, one file per group of commands. It composes every other package.

May import: every package; nothing imports this folder.
Interface: `app.main` is the command `sightline`.
"""

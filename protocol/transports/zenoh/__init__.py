"""Zenoh as a `Link`.

May import: `protocol`, zenoh.
Interface: `link.ZenohLink` for one robot, `link.ZenohFleet` for many, `discovery` and `presence` to find them.
"""

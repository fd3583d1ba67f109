"""The small processes that stop a robot when everything else is busy or dead; standard library only.

May import: `protocol`, `robot_side`; no third-party package, since each process stays below 15 MB.
Interface: `stop_receiver.start` and `stop_forwarder.start` start a process; `stop_core` is their logic.
"""

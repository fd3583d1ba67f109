"""Small processes that stop a robot when other processes are busy or dead; standard library only.

`process` is the guardian: it starts the driver process, and stops the wheels when that process is dead or hangs. The
STOP receiver and the STOP forwarder read the STOP port.

May import: `protocol`, `robot_side`; no third-party package, because each process stays below 15 MB. `start` runs
    outside these processes, so it may import the configuration.
Interface: `start.become_guardian` turns a process into the guardian of its fork, `core` is the logic of the guardian;
    `stop_receiver.start` and `stop_forwarder.start` start a process, `stop_core` is their logic.
"""

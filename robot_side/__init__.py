"""The robot service: a guardian, a driver process with motors and gate, a network process with camera and link.

May import: `protocol`; no NumPy, OpenCV or PyBullet.
Interface: `guardian.start` and `driver.process` are the service; `ports` is the interface of a device plug-in;
    `config.RobotConfig`.
"""

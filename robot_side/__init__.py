"""The robot service: a driver process with motors and safety gate, a network process with camera and link.

May import: `protocol`; no NumPy, OpenCV or PyBullet.
Interface: `driver.process` is the service; `ports` is what a device plug-in implements; `config.RobotConfig`.
"""

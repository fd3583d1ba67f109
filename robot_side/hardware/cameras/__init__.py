"""Camera plug-ins: V4L2, Raspberry Pi, files.

May import: `protocol`, `robot_side`; OpenCV or picamera2 when a camera is opened.
Interface: The entry points of the group `sightline.cameras`; `lens` and `timing` for third-party cameras.
"""

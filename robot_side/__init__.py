"""The robot service: a driver process with motors and safety gate, a network process with camera and link. Needs no
NumPy, OpenCV or PyBullet.
"""

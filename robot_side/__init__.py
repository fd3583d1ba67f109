"""What runs on the robot: gate, motors, camera, link. Needs no NumPy, OpenCV or PyBullet."""

"""The network process: owns camera and link."""

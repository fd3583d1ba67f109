"""The driver process: owns motors, gate and STOP latch; has no network."""

"""Detectors that are ONNX models.

May import: `protocol`, `vision_side`; ONNX Runtime.
Interface: The entry point `onnx`, also as `onnx:PATH`.
"""

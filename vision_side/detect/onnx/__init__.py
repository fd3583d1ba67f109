"""Detectors that are ONNX models."""

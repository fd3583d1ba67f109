"""Modules of vision_side.detect.onnx."""

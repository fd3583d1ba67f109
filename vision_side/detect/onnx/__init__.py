"""Modules of sightline.vision_side.detect.onnx."""

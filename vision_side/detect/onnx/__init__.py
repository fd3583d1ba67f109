"""Detectors with a trained model: ONNX files, and adapters of PyTorch, Ultralytics and Transformers.

May import: `protocol`, `vision_side`; ONNX Runtime, and inside functions the frameworks.
Interface: The entry points `onnx`, `torch`, `ultralytics` and `transformers`, each with `:PATH`.
"""

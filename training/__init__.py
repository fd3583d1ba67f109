"""Trains the shipped detector: scenes, network, loop, export, model card.

May import: `protocol`, `sim`, `vision_side`, `evaluation`; PyTorch, ONNX.
Interface: `sightline train` runs `scenes`, `loop` and `shipping` in this order.
"""

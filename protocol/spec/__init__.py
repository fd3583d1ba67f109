"""What is generated from the models: README tables, JSON Schema, AsyncAPI and the golden vectors. No service imports
it.
"""

"""What else a user might have built: the same pictures, the same pipeline, other ways between them."""

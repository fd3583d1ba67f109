"""The conformance kit's own tests: a reference robot in virtual time, and one deliberately broken peer per case."""

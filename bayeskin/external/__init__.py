"""Forward models from outside of the package: a Python function, or a server that speaks UM-Bridge."""

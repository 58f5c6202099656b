"""Forward models from outside the package: a Python function, or a server that speaks UM-Bridge."""

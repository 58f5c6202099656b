"""The choice of a further test: protocols within a device's limits, and what each is expected to tell."""

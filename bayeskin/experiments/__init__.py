"""Chooses a further test: makes protocols within a device's limits and estimates what each would tell."""

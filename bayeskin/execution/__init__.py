"""Executors: they apply one function to many items, in processes of this machine or on a cluster."""

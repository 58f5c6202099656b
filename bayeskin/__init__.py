"""bayeskin: what living skin is made of, how sure one can be, and what the model leaves out."""

__version__ = "0.1.0"

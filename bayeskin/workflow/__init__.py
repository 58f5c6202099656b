"""The stages of a run, from a recording to its report; each of them can be resumed."""

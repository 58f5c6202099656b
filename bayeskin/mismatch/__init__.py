"""Finds where a recording and the model differ, which physics is left out, and what stays unexplained."""

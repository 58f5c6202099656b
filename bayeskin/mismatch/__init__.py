"""Where a recording and the model differ, which physics was left out, and what remains."""

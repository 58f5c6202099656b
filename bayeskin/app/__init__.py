"""The page on loopback, for people who do not use a terminal: from a recording to the report."""

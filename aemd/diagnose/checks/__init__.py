"""The checks, one family a file: each a function of a fit that returns evidence with a known law."""

"""The mechanisms as terms of the fit, one family a file."""

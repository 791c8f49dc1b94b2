"""From readings to estimates: the paper's filters and their rivals, without clock, file, thread or logger."""

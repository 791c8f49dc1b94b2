"""A day at 15 Hz in a storm of faults, in a minute: `python -m tests.storm --seed N`."""

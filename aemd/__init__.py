"""aemd: read a digital multimeter without losing a reading, estimate the true input, record both.

The way of a reading, and of the tree:

    acquire/   instrument -> ring: the meter's memory drained by one thread, every reading counted and timed
    estimate/  readings -> estimates: the paper's filters and better ones, kernels without I/O
    record/    readings and estimates -> MCAP, and back
    pipeline   the one loop that a live acquisition and a replay both run

`model/` states what we believe generates the readings; drivers and their simulators are found by entry point.
"""

__version__ = "0.1.0"

"""From the instrument to the ring: every reading drained, counted and timed."""

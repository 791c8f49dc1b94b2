"""Looking at a running acquisition from another process: its state, and a view for a terminal."""

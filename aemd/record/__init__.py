"""From readings and estimates to MCAP, and back."""

"""The generative model: what we believe makes the readings, as composable terms with physical parameters."""

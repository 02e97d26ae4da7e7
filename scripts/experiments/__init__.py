"""The paper's experiments: every strategy and run of one in a single batch of worlds."""

"""Final particles of the experiments, simulated again with other engines, steps and hands."""

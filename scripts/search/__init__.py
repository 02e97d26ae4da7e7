"""Which optimiser finds a good hand in the fewest grasps: many seeds of each, in lock step."""

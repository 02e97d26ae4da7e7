"""What accuracy costs in time: errors and times of settings against a converged reference."""

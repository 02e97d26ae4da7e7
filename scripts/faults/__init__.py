"""What happens when things go wrong, counted: kills, full disks, damage, hostile input."""

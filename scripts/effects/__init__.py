"""What each effect of a scene costs and decides."""

"""The page of `codesign studio`: a hand in 3D with a slider for each parameter of its design."""

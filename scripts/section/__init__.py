"""A finger's section by finite elements: walls and threads under pressure, bending and twist."""

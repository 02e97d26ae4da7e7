"""A step's linear system over the tree of bodies: its terms, elimination and substitution."""

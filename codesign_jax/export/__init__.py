"""A design that leaves the program: MuJoCo models, commands, parts to cast, a build sheet."""

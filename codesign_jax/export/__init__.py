"""A design that leaves the program: MuJoCo models, commands, parts to cast, a build sheet.

`codesign export` writes all of it. The commands in its table belong to these phases of a grasp:

>>> from codesign_jax import scene
>>> list(scene.load("paper").phase_ends)
['approach', 'inflate', 'lift', 'disturb', 'ungrasp']
"""

"""A design that leaves the program: MuJoCo models, commands, parts to cast, a build sheet.

`codesign export` writes all of it. The commands in its table belong to these phases of a grasp:

>>> from codesign_jax import export, parameters, scene
>>> from codesign_jax.export import grasps
>>> [name for name, _ in grasps.phases(scene.load("paper"))]
['approach', 'inflate', 'lift', 'disturb', 'ungrasp']
"""

"""Figures, animations and words; nothing numerical imports this package.

>>> from codesign_jax import scene
>>> from codesign_jax.judge import sentences
>>> sentences.objects(scene.load("paper"))  # what a verdict in this scene holds for
'objects of 50 g, friction 0.85'
"""

"""codesign-jax: batched simulation of soft hands and co-design of their morphology and control."""

"""Laws of one palm, link, joint, contact, vertex or shape: pure functions, which know no memory."""
